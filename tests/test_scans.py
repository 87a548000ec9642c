"""Scans read from files: planar or not, every other one, with poses; and what does not fit together."""

import dataclasses
import re

import numpy as np
import pytest

from bbr_layer import read_cloud, write_cloud, write_poses_kitti, write_poses_tum
from train.scans import ScanSet, planar_poses, read_scan_set


def turns(count):
    """Poses in the plane that move and turn."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for number, pose in enumerate(poses):
        c, s = np.cos(0.1 * number), np.sin(0.1 * number)
        pose[:2, :2], pose[:2, 3] = [[c, -s], [s, c]], [number, -number]
    return poses


@pytest.fixture
def folder(tmp_path, rng):
    """Twelve planar scans of rising size, named so that plain sorting would mix them up."""
    for number in range(12):
        flat = np.column_stack((rng.uniform(1, 2, size=(number + 10, 2)), np.zeros(number + 10)))
        write_cloud(tmp_path / f"scan{number}.ply", flat)
    return tmp_path


def test_a_folder_is_read_in_natural_order_and_planar(folder):
    scans = read_scan_set([folder])
    assert scans.dimension == 2
    assert [len(points) for points in scans.points] == list(range(10, 22))
    assert scans.names[10] == "scan10.ply"
    assert scans.timestamps.tolist() == list(range(12))
    assert scans.start is None and scans.truth is None


def test_one_point_off_the_plane_makes_all_scans_3d(folder):
    write_cloud(folder / "scan5.ply", read_cloud(folder / "scan5.ply").points + 0.5 * np.eye(15, 3, -4))
    assert read_scan_set([folder]).dimension == 3


def test_scans_at_one_height_are_planar_and_their_height_is_told(folder):
    for path in folder.glob("*.ply"):
        write_cloud(path, read_cloud(path).points + [0, 0, 0.3])
    scans = read_scan_set([folder])
    assert scans.dimension == 2 and scans.notes == ("all points lie at z = 0.3; they are mapped in the plane",)


def test_a_point_too_far_to_have_been_seen_is_left_out_and_told(folder):
    points = read_scan_set([folder]).points
    write_cloud(folder / "scan5.ply", np.column_stack((np.insert(points[5], 3, [65535, 0], axis=0), np.zeros(16))))
    scans = read_scan_set([folder])
    np.testing.assert_array_equal(scans.points[5], points[5])
    assert len(scans.notes) == 1 and "1 in scan5.ply" in scans.notes[0]


def test_files_that_are_called_like_something_else_are_told(tmp_path, rng):
    for name in ("s0.csv", "s1.csv", "groundtruth.csv", "times.csv", ".hidden.csv", "times.txt"):
        np.savetxt(tmp_path / name, rng.normal(size=(20, 3)), delimiter=",")
    scans = read_scan_set([tmp_path])
    assert scans.names == ["s0.csv", "s1.csv"]
    assert scans.notes == ("not taken for scans, for their names: groundtruth.csv, times.csv",)
    assert read_scan_set([tmp_path / "s0.csv", tmp_path / "times.csv"]).notes == ()


def test_files_are_read_in_the_order_given(folder):
    scans = read_scan_set([folder / "scan7.ply", folder / "scan2.ply"])
    assert scans.names == ["scan7.ply", "scan2.ply"]
    assert len(scans.points[0]) == 17


def test_an_npz_of_several_scans(tmp_path, rng):
    points, offsets = rng.normal(size=(25, 3)), np.array([0, 12, 25])
    np.savez(tmp_path / "all.npz", points=points, offsets=offsets)
    scans = read_scan_set([tmp_path / "all.npz"])
    np.testing.assert_array_equal(scans.points[1], points[12:])


@pytest.mark.parametrize("before_stride", [True, False])
def test_the_stride_takes_poses_along(folder, before_stride):
    write_poses_tum(folder / "truth.txt", turns(12), np.arange(12.0))
    write_poses_kitti(folder / "start.txt", turns(12) if before_stride else turns(12)[::5])
    scans = read_scan_set([folder], truth=folder / "truth.txt", start=folder / "start.txt", stride=5)
    assert scans.names == ["scan0.ply", "scan5.ply", "scan10.ply"]
    assert scans.timestamps.tolist() == [0, 5, 10]
    np.testing.assert_allclose(scans.truth, planar_poses(turns(12)[::5], "truth"), atol=1e-9)
    np.testing.assert_allclose(scans.start, scans.truth, atol=1e-9)


def test_progress_is_told_of_every_scan(folder):
    told = []
    read_scan_set([folder], progress=lambda *news: told.append(news))
    assert told[0] == ("reading", 1, 12) and told[-1] == ("reading", 12, 12)


def test_poses_of_another_number_are_refused(folder):
    write_poses_tum(folder / "truth.txt", turns(11), np.arange(11.0))
    with pytest.raises(ValueError, match=r"truth: .*truth.txt holds 11 poses; the scans need 12"):
        read_scan_set([folder], truth=folder / "truth.txt")


def test_poses_off_the_plane_of_planar_scans_are_refused(folder):
    poses = turns(12)
    poses[3, 2, 3] = 0.1
    write_poses_tum(folder / "start.txt", poses, np.arange(12.0))
    with pytest.raises(ValueError, match=r"start: .* leaves the plane z = 0"):
        read_scan_set([folder], start=folder / "start.txt")


def test_a_folder_without_scans_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="holds no scans"):
        read_scan_set([tmp_path])


def test_one_scan_is_no_map(folder):
    with pytest.raises(ValueError, match="needs at least 2"):
        read_scan_set([folder], stride=12)


SCAN = np.arange(1.0, 25.0).reshape(12, 2)
BESIDE = np.array([[0.0, 0.0], [1.0, 2.0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"names": ["a"]}, "2 scans came with 1 names"),
        ({"points": [SCAN, SCAN.reshape(8, 3)]}, "scan b has shape (8, 3)"),
        ({"points": [SCAN, np.zeros((0, 2))]}, "of the 0 points of scan b 0 are off its origin and differ"),
        ({"points": [np.full((12, 2), np.nan), SCAN]}, "scan a is not finite"),
        ({"points": [SCAN, SCAN[:9]]}, "of the 9 points of scan b 9 are off its origin and differ; a pose needs at"),
        ({"points": [np.zeros((180, 2)), SCAN]}, "of the 180 points of scan a 0 are off its origin"),
        ({"points": [SCAN, np.ones((180, 2))]}, "of the 180 points of scan b 1 are off its origin"),
        ({"points": [SCAN, np.concatenate((np.tile(BESIDE, (90, 1)), SCAN[:9]))]}, "of the 189 points of scan b 9 are"),
        ({"truth": np.tile(np.eye(4), (2, 1, 1))}, "truth has shape (2, 4, 4)"),
        ({"start": np.tile(np.eye(3), (3, 1, 1))}, "start has shape (3, 3, 3)"),
    ],
)
def test_what_does_not_fit_is_named(as_a_user, change, words):
    fields = {"points": [SCAN, SCAN + 1], "names": ["a", "b"], "timestamps": np.arange(2.0)}
    with pytest.raises(ValueError, match=re.escape(words)):
        ScanSet(**(fields | change))


def test_the_fingerprint_follows_points_and_starting_poses_alone(folder):
    scans = read_scan_set([folder])
    same = dataclasses.replace(
        scans, names=[f"other {name}" for name in scans.names], truth=planar_poses(turns(12), "")
    )
    assert same.fingerprint() == scans.fingerprint()
    moved = [points + (number == 4) * 1e-9 for number, points in enumerate(scans.points)]
    assert dataclasses.replace(scans, points=moved).fingerprint() != scans.fingerprint()
    assert dataclasses.replace(scans, start=planar_poses(turns(12), "")).fingerprint() != scans.fingerprint()


def test_far_poses_are_planar_to_the_digits_of_a_file():
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, 3] = [1e6, 0.0, 1.0]
    assert planar_poses(poses, "start")[1, 0, 2] == 1e6
