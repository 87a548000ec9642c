"""Reading clouds: real files as people have them, and folders of scans."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bbr_layer import read_cloud, read_scans, scan_paths, write_cloud


@pytest.fixture
def points(rng):
    return rng.normal(size=(40, 3))


@pytest.mark.parametrize(
    ("name", "shape", "more"),
    [
        ("ascii.pcd", (361, 3), ""),
        ("binary.pcd", (1318, 3), "intensity"),
        ("binary_compressed.pcd", (10031, 3), ""),
        ("lidar_source.ply", (69792, 3), "intensity"),
        ("lidar_target.ply", (69088, 3), "intensity"),
        ("ascii_odd_header.ply", (14879, 3), ""),
        ("mesh_with_faces.ply", (453, 3), "intensity"),
        ("points.xyz", (20702, 3), ""),
        ("points_2d.csv", (361, 2), ""),
        ("six_columns.bin", (16384, 3), "normals"),
        ("kitti/velodyne/000000.bin", (124668, 3), "intensity"),
        ("deepmapping_v1_pose0/017.pcd", (256, 3), ""),
    ],
)
def test_real_file(real_data, name, shape, more):
    cloud = read_cloud(real_data / "formats" / name)
    assert cloud.points.shape == shape
    assert cloud.points.dtype == np.float64
    assert np.isfinite(cloud.points).all()
    assert (cloud.normals is not None) == (more == "normals")
    assert (cloud.intensity is not None) == (more == "intensity")
    assert cloud.dropped == 0


def test_lidar_pair_lies_together_under_its_reference_motion(real_data):
    folder = real_data / "formats"
    source, target = (read_cloud(folder / f"lidar_{side}.ply").points for side in ("source", "target"))
    target_from_source = np.loadtxt(folder / "T_target_source.txt")
    moved = source @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    tree = cKDTree(target)
    unmoved, after = (np.percentile(tree.query(cloud)[0], 75) for cloud in (source, moved))
    assert after < 0.15  # metres; a quarter of the source sees what the target does not
    assert after < 0.6 * unmoved


def test_scan_with_an_odd_header_is_the_first_stanford_bunny_scan(real_data):
    cloud = read_cloud(real_data / "formats" / "ascii_odd_header.ply")
    np.testing.assert_allclose(cloud.points[0], [0.0119346, 0.0530818, 0.0650144])
    assert (np.ptp(cloud.points, axis=0) < 0.2).all()  # a bunny of 15 cm, in metres


def test_six_columns_are_points_and_unit_normals(real_data):
    cloud = read_cloud(real_data / "formats" / "six_columns.bin")
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0)
    # Planes of a street: moving along the normal leaves the surface faster than moving across it.
    nearest = cloud.points[cKDTree(cloud.points).query(cloud.points[::50], k=2)[1][:, 1]] - cloud.points[::50]
    across = np.abs((nearest * cloud.normals[::50]).sum(1)) / np.linalg.norm(nearest, axis=1)
    assert np.median(across) < 0.3  # 0.5 for normals that have nothing to do with the points


def test_kitti_reflectance_is_a_share(real_data):
    intensity = read_cloud(real_data / "formats" / "kitti" / "velodyne" / "000001.bin").intensity
    assert 0.0 <= intensity.min() < intensity.max() <= 1.0


def test_folder_of_2d_scans_matches_the_compact_set(real_data):
    scans = read_scans(real_data / "formats" / "deepmapping_v1_pose0")
    with np.load(real_data / "seq_deepmapping2d_v1_pose0.npz") as compact:
        first, last = compact["points"][:256], compact["points"][-256:]
    assert len(scans) == 256
    np.testing.assert_allclose(scans[0].points, first, atol=1e-6)
    np.testing.assert_allclose(scans[255].points, last, atol=1e-6)


def test_sequence_folder_of_kitti_is_read_from_its_velodyne(real_data):
    found = scan_paths(real_data / "formats" / "kitti")
    assert [path.name for path in found] == ["000000.bin", "000001.bin"]


def test_compact_sequence_is_cut_at_its_offsets(real_data):
    path = real_data / "seq_stanford_bunny.npz"
    with np.load(path) as compact:
        sizes = np.diff(compact["offsets"])
    assert [len(scan.points) for scan in read_scans(path)] == sizes.tolist()
    with pytest.raises(ValueError, match="10 scans, not one; read_scans"):
        read_cloud(path)


def test_scans_come_in_natural_order_without_their_companions(tmp_path, points):
    for name in (
        "scan10.csv",
        "scan9.csv",
        "scan1.csv",
        "poses.txt",
        "calib.txt",
        "times.txt",
        ".hidden.csv",
    ):
        (tmp_path / name).write_text("1 2 3\n4 5 6\n")
    assert [path.name for path in scan_paths(tmp_path)] == ["scan1.csv", "scan9.csv", "scan10.csv"]
    write_cloud(tmp_path / "b.ply", points)
    assert [path.name for path in scan_paths(tmp_path)] == ["b.ply"]
    assert len(read_scans([tmp_path / "b.ply", tmp_path / "scan1.csv"])) == 2


BESIDE_SCANS = (
    *("groundtruth.txt", "ground_truth.csv", "GT.txt", "poses_tum.txt", "left_poses.csv", "frame-000000.pose.txt"),
    *("pose_01.txt", "times.txt", "timestamps_left.txt", "scan_stamps.csv", "calib_cam_to_velo.txt", "traj.txt"),
    *("stamped_traj_estimate.txt", "odometry.csv", "01_labels.npy", "README.txt", "time.txt"),
)
CALLED_SO = (
    *("t_000.csv", "time_000.csv", "gtsam_0.csv", "truck_0.csv", "v1_pose0.csv", "compose1.csv", "posed.csv"),
    *("timestamp_1305031102.csv", "stampede.csv", "labelled_1.csv", "tracks.csv"),
)


@pytest.mark.parametrize("name", BESIDE_SCANS)
def test_what_lies_beside_scans_is_no_scan(tmp_path, name):
    for file in ("scan0.csv", "scan1.csv", name):
        (tmp_path / file).write_text("1 2 3\n4 5 6\n")
    assert [path.name for path in scan_paths(tmp_path)] == ["scan0.csv", "scan1.csv"]


@pytest.mark.parametrize("name", CALLED_SO)
def test_scans_may_be_called_nearly_so(tmp_path, name):
    (tmp_path / name).write_text("1 2 3\n4 5 6\n")
    assert [path.name for path in scan_paths(tmp_path)] == [name]


def test_a_number_in_a_circle_is_no_number(tmp_path):
    for name in ("①2.csv", "①10.csv", "²1.csv"):
        (tmp_path / name).write_text("1 2 3\n4 5 6\n")
    assert {path.name for path in scan_paths(tmp_path)} == {"²1.csv", "①2.csv", "①10.csv"}


def test_folders_without_scans(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no scans; files ending .ply"):
        scan_paths(tmp_path)
    (tmp_path / "pose_0.csv").write_text("1 2 3\n")
    with pytest.raises(FileNotFoundError, match=r"by their names pose_0.csv are none: name such files"):
        scan_paths(tmp_path)
    with pytest.raises(FileNotFoundError, match="not a folder"):
        read_scans(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="list of scans is empty"):
        read_scans([])
