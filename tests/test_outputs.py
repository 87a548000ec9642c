"""The files of a run: each is there, and the poses and the map in them can be read back."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import yaml
from map_problems import SETTINGS, room_result, some_edges
from PIL import Image

from bbr_layer import read_cloud, read_poses, read_poses_tum
from train.outputs import MapResult, write_outputs
from train.run_folder import MAP, MAP_FILES

ALWAYS = {
    *("poses_tum.txt", "poses.npz", "map.ply", "map.html", "metrics.json", "config.yaml"),
    *("trajectory.png", "map.png", "occupancy.png", "occupancy.yaml"),
}
EXTRA = {2: {"losses.png", "occupancy_network.png"}, 3: {"losses.png", "occupancy_network.png", "poses_kitti.txt"}}


@pytest.fixture(scope="module", params=[2, 3])
def run(request, tmp_path_factory) -> Iterator[tuple[int, MapResult, Path]]:
    """The dimension, a result with everything in it, and the folder it was written to; pictures are small."""
    d, out = request.param, tmp_path_factory.mktemp("run") / "new" / "out"
    losses = {"total": [3.0, 2.0], "registration": [1.0, 0.5]}
    result = replace(room_result(d), losses=losses, edges=some_edges(d), occupancy=lambda places: places[:, 0] > 0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.drawing.DPI", 40)
        write_outputs(out, result)
    yield d, result, out


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr("train.drawing.DPI", 40)


def test_all_files_are_there_and_the_pictures_are_pictures(run):
    d, _, out = run
    assert {path.name for path in out.iterdir()} == ALWAYS | EXTRA[d]
    assert ALWAYS | EXTRA[3] | {"movers.ply"} == {*MAP_FILES, "config.yaml"}, "what another run takes away"
    for picture in out.glob("*.png"):
        with Image.open(picture) as image:
            image.verify()


def test_poses_are_read_back(run):
    d, result, out = run
    expected = np.tile(np.eye(4), (5, 1, 1))
    expected[:, :2, :2], expected[:, :d, 3] = np.eye(2), result.world_from_scan[:, :d, d]
    for name in ["poses_tum.txt", "poses.npz", *(["poses_kitti.txt"] if d == 3 else [])]:
        np.testing.assert_allclose(read_poses(out / name), expected, atol=1e-12)
    timestamps, _ = read_poses_tum(out / "poses_tum.txt")
    np.testing.assert_allclose(timestamps, result.scans.timestamps)
    with np.load(out / "poses.npz", allow_pickle=False) as arrays:
        assert arrays["names"].tolist() == result.scans.names
        np.testing.assert_allclose(arrays["truth"][:, :d, 3], result.scans.truth[:, :d, d])


def test_the_map_holds_every_point_where_its_pose_puts_it(run):
    d, result, out = run
    vertices = plyfile.PlyData.read(out / "map.ply")["vertex"]
    points = read_cloud(out / "map.ply").points[:, :d]
    for i, (scan, pose) in enumerate(zip(result.scans.points, result.world_from_scan, strict=True)):
        np.testing.assert_allclose(points[vertices["scan"] == i], scan + pose[:d, d], atol=1e-12)


def test_the_map_is_coloured_by_height_or_in_2d_by_scan(run):
    d, _, out = run
    vertices = plyfile.PlyData.read(out / "map.ply")["vertex"]
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], axis=1).astype(int)
    by = vertices["z"] if d == 3 else vertices["scan"]
    assert np.abs(colours[np.argmin(by)] - colours[np.argmax(by)]).sum() > 100


def test_settings_are_read_back(run):
    assert yaml.safe_load((run[2] / "config.yaml").read_text(encoding="utf-8")) == SETTINGS


def test_a_second_run_takes_away_what_it_does_not_write(tmp_path):
    for name in EXTRA[3]:
        (tmp_path / name).write_text("of an earlier run")
    write_outputs(tmp_path, room_result(2))
    assert {path.name for path in tmp_path.iterdir()} == ALWAYS


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (np.tile(np.eye(3), (4, 1, 1)), "5 scans need"),
        (np.tile(np.eye(4), (5, 1, 1)), "5 scans need"),
        (np.where(np.arange(5)[:, None, None] == 3, np.nan, np.eye(3)), "first at scan scan 3"),
    ],
)
def test_poses_that_do_not_fit_leave_nothing_behind(poses, words, tmp_path):
    with pytest.raises(ValueError, match=words):
        write_outputs(tmp_path / "out", replace(room_result(), world_from_scan=poses))
    assert not (tmp_path / "out").exists()


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(NotADirectoryError, match="name a folder"):
        write_outputs(tmp_path / "out", room_result())
    assert (tmp_path / "out").read_text() == "mine"


def test_a_picture_that_fails_leaves_no_half_file(tmp_path, monkeypatch):
    def fail(figure, path, **settings):
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", fail)
    with pytest.raises(OSError, match="disk full"):
        write_outputs(tmp_path, room_result())
    assert not list(tmp_path.glob("*trajectory*"))
    assert (tmp_path / "poses_tum.txt").exists() and not (tmp_path / MAP).exists(), "a map is there once all of it is"


def test_progress_and_metrics_are_told(tmp_path):
    told = []
    metrics = write_outputs(tmp_path, replace(room_result(), edges=some_edges(2)), lambda *call: told.append(call))
    assert told[-1] == ("pictures", 2, 2) and ("occupancy", 5, 5) in told
    assert metrics["edges"] == {"odometry": 2, "window": 0, "loop": 1}
