"""Trajectories in files: round trips, evo's own readers, and what wrong files are told."""

import os

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bbr_layer import read_poses, read_poses_kitti, read_poses_tum, write_poses_kitti, write_poses_tum


@pytest.fixture
def world_from_scan(rng):
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, :3] = Rotation.random(6, rng).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(6, 3)) * 100
    poses[0] = np.eye(4)
    return poses


@pytest.fixture
def timestamps():
    return 1_700_000_000.1 + 0.1 * np.arange(6)  # seconds since 1970, as loggers write them


def test_tum_round_trip(tmp_path, world_from_scan, timestamps):
    write_poses_tum(tmp_path / "a.txt", world_from_scan, timestamps)
    times, poses = read_poses_tum(tmp_path / "a.txt")
    np.testing.assert_array_equal(times, timestamps)
    np.testing.assert_array_equal(poses[:, :3, 3], world_from_scan[:, :3, 3])
    np.testing.assert_allclose(poses, world_from_scan, atol=1e-14)
    np.testing.assert_array_equal(read_poses(tmp_path / "a.txt"), poses)


def test_kitti_round_trip(tmp_path, world_from_scan):
    write_poses_kitti(tmp_path / "a.txt", world_from_scan)
    np.testing.assert_array_equal(read_poses_kitti(tmp_path / "a.txt"), world_from_scan)
    np.testing.assert_array_equal(read_poses(tmp_path / "a.txt"), world_from_scan)


def test_evo_reads_the_same(tmp_path, world_from_scan, timestamps):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    write_poses_tum(tmp_path / "tum.txt", world_from_scan, timestamps)
    write_poses_kitti(tmp_path / "kitti.txt", world_from_scan)
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "tum.txt"))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "kitti.txt"))
    np.testing.assert_array_equal(tum.timestamps, timestamps)
    np.testing.assert_allclose(np.array(tum.poses_se3), world_from_scan, atol=1e-12)
    np.testing.assert_allclose(np.array(kitti.poses_se3), world_from_scan, atol=1e-12)


def test_we_read_what_evo_writes(tmp_path, world_from_scan, timestamps):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    trajectory = pytest.importorskip("evo.core.trajectory")
    written = trajectory.PoseTrajectory3D(poses_se3=list(world_from_scan), timestamps=timestamps)
    file_interface.write_tum_trajectory_file(str(tmp_path / "tum.txt"), written)
    file_interface.write_kitti_poses_file(str(tmp_path / "kitti.txt"), written)
    np.testing.assert_allclose(read_poses(tmp_path / "tum.txt"), world_from_scan, atol=1e-12)
    np.testing.assert_allclose(read_poses(tmp_path / "kitti.txt"), world_from_scan, atol=1e-12)


def test_kitti_poses_of_the_velodyne(real_data):
    folder = real_data / "formats" / "kitti"
    camera = read_poses_kitti(folder / "poses.txt")
    velodyne = read_poses_kitti(folder / "poses.txt", folder / "calib.txt")
    # The car drives 0.86 m forwards: along z of the camera and along x of the velodyne.
    np.testing.assert_allclose(camera[1, :3, 3], [-0.0469, -0.0284, 0.8587], atol=1e-4)
    np.testing.assert_allclose(velodyne[1, :3, 3], [0.8587, 0.0469, 0.0284], atol=0.02)
    np.testing.assert_allclose(velodyne[0], np.eye(4), atol=1e-6)
    step = Rotation.from_matrix(camera[1, :3, :3]).magnitude()
    assert Rotation.from_matrix(velodyne[1, :3, :3]).magnitude() == pytest.approx(step, rel=1e-3)


def test_poses_in_npz(tmp_path, world_from_scan):
    for key in ("poses", "world_from_scan"):
        np.savez(tmp_path / "a.npz", **{key: world_from_scan}, other=1)
        np.testing.assert_array_equal(read_poses(tmp_path / "a.npz"), world_from_scan)


def test_2d_poses_are_embedded_in_3d(tmp_path):
    angle = 0.3
    flat = np.array([[np.cos(angle), -np.sin(angle), 2], [np.sin(angle), np.cos(angle), 3], [0, 0, 1]])
    np.savez(tmp_path / "a.npz", poses=flat[None])
    pose = read_poses(tmp_path / "a.npz")[0]
    np.testing.assert_allclose(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), [0, 0, angle])
    np.testing.assert_array_equal(pose[:3, 3], [2, 3, 0])


def test_comments_and_quaternions_of_any_length(tmp_path):
    (tmp_path / "a.txt").write_text("# timestamp tx ty tz qx qy qz qw\n\n0.5 1 2 3 0 0 2 2\n")
    times, poses = read_poses_tum(tmp_path / "a.txt")
    assert times.tolist() == [0.5]
    np.testing.assert_allclose(Rotation.from_matrix(poses[0, :3, :3]).as_rotvec(), [0, 0, np.pi / 2])


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "has 0 numbers a line"),
        ("1 2 3\n", "has 3 numbers a line; a trajectory has 8"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0\n", "no trajectory as TUM"),
        ("0 1 2 3 0 0 0 0\n", "a quaternion of zeros"),
        ("0 nan 2 3 0 0 0 1\n", "NaN or infinite"),
        ("1 0 0 0 0 2 0 0 0 0 1 0\n", r"no rigid motion \(the first is number 0\)"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "no rigid motion"),
    ],
)
def test_wrong_trajectories(tmp_path, content, words):
    (tmp_path / "a.txt").write_text(content)
    with pytest.raises(ValueError, match=words):
        read_poses(tmp_path / "a.txt")


def test_wrong_npz_and_missing_files(tmp_path):
    np.savez(tmp_path / "a.npz", other=1)
    with pytest.raises(ValueError, match="an array named poses is wanted"):
        read_poses(tmp_path / "a.npz")
    (tmp_path / "b.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match="cannot be read as a trajectory"):
        read_poses(tmp_path / "b.npz")
    with pytest.raises(FileNotFoundError, match="does not exist"):
        read_poses(tmp_path / "c.txt")
    (tmp_path / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(ValueError, match="no line 'Tr:'"):
        read_poses_kitti(tmp_path / "poses.txt", tmp_path / "calib.txt")


@pytest.mark.usefixtures("as_a_user")
def test_nothing_wrong_is_written(tmp_path, world_from_scan, timestamps):
    with pytest.raises(ValueError, match=r"shape \(6, 3, 3\)"):
        write_poses_kitti(tmp_path / "a.txt", world_from_scan[:, :3, :3])
    with pytest.raises(ValueError, match="timestamps have shape"):
        write_poses_tum(tmp_path / "a.txt", world_from_scan, timestamps[:2])
    world_from_scan[3, 0, 3] = np.nan
    with pytest.raises(ValueError, match="NaN or infinite"):
        write_poses_kitti(tmp_path / "a.txt", world_from_scan)
    assert os.listdir(tmp_path) == []


def test_the_first_pose_that_is_no_motion_is_named(tmp_path):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[2, :3, :3] = np.diag([1.0, 1.0, -1.0])
    with pytest.raises(ValueError, match="number 2"):
        write_poses_kitti(tmp_path / "p.txt", poses)
