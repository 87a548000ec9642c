"""Writing clouds: round trips, other readers, and what is refused."""

import os

import numpy as np
import pytest
import trimesh

from bbr_layer import read_cloud, write_cloud


@pytest.fixture
def points(rng):
    return rng.normal(size=(40, 3))


@pytest.fixture
def normals(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("suffix", [".ply", ".npz", ".csv", ".xyz", ".pcd"])
@pytest.mark.parametrize("width", [np.float32, np.float64])
def test_what_is_written_is_read_back(tmp_path, points, normals, suffix, width):
    path, intensity = tmp_path / f"cloud{suffix}", np.arange(40)
    colours = np.tile(np.uint8([255, 128, 0]), (40, 1))
    write_cloud(
        path,
        points.astype(width),
        normals=normals.astype(width),
        columns={"intensity": intensity, "moving": intensity > 7},
        colours=colours,
    )
    cloud = read_cloud(path)
    exact = points.astype(np.float32 if suffix == ".pcd" else width)
    np.testing.assert_array_equal(cloud.points.astype(exact.dtype), exact)
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-7)
    np.testing.assert_array_equal(cloud.intensity, intensity)
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("suffix", [".ply", ".npz", ".csv", ".xyz", ".pcd"])
def test_2d_clouds_keep_their_dimension_where_the_format_has_one(tmp_path, points, suffix):
    path = tmp_path / f"flat{suffix}"
    write_cloud(path, points[:, :2].astype(np.float32))
    read = read_cloud(path).points
    assert read.shape[1] == (3 if suffix in (".ply", ".pcd") else 2)
    np.testing.assert_array_equal(read[:, :2].astype(np.float32), points[:, :2].astype(np.float32))
    assert (read[:, 2:] == 0).all()


def test_colours_and_columns_reach_other_readers(tmp_path, points):
    colours = np.tile(np.uint8([255, 128, 0]), (40, 1))
    write_cloud(tmp_path / "a.ply", points, colours=colours, columns={"weight": np.arange(40) * 10**12})
    seen = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_array_equal(seen.colors[:, :3], colours)
    np.testing.assert_array_equal(seen.vertices, points)
    raw = seen.metadata["_ply_raw"]["vertex"]["data"]["weight"]
    np.testing.assert_array_equal(raw, np.arange(40) * 10**12)


@pytest.mark.usefixtures("as_a_user")
def test_what_cannot_be_written(tmp_path, points, normals):
    for arguments, words in (
        ({"path": "a.xls", "points": points}, r"suffix '.xls'; writable are .ply"),
        ({"path": "a.ply", "points": points[:0]}, r"shape \(0, 3\)"),
        ({"path": "a.ply", "points": points, "normals": normals[:5]}, r"normals have shape \(5, 3\)"),
        ({"path": "a.ply", "points": points, "columns": {"x": points[:, 0]}}, "may not hold 'x'"),
        ({"path": "a.ply", "points": points, "columns": {"w": points[:3, 0]}}, r"w have shape \(3,\)"),
        ({"path": "a.ply", "points": points, "columns": {"w": np.array(["a"] * 40)}}, "numbers are wanted"),
    ):
        with pytest.raises(ValueError, match=words):
            write_cloud(tmp_path / arguments.pop("path"), **arguments)
    assert list(tmp_path.iterdir()) == []
