"""Formats and layouts of cloud files, meshes, and what is left out of a cloud."""

import struct

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from bbr_layer import read_cloud, sample_surface, write_cloud


@pytest.fixture
def points(rng):
    return rng.normal(size=(40, 3))


@pytest.fixture
def normals(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off"])
def test_mesh_gives_each_vertex_once_and_samples_on_request(tmp_path, suffix):
    path = tmp_path / f"box{suffix}"
    trimesh.creation.box(extents=(1, 2, 3)).export(path)
    corners = read_cloud(path).points
    assert corners.shape == (8, 3)
    np.testing.assert_allclose(np.abs(corners), np.tile([0.5, 1.0, 1.5], (8, 1)))
    sampled = sample_surface(path, 500, seed=1)
    outermost = np.abs(sampled.points / [0.5, 1.0, 1.5]).max(axis=1)
    np.testing.assert_allclose(outermost, 1.0)
    assert np.allclose(np.abs(sampled.normals).max(axis=1), 1.0)
    np.testing.assert_array_equal(sampled.points, sample_surface(path, 500, seed=1).points)


def test_real_mesh_is_sampled_on_its_surface(real_data):
    path = real_data / "formats" / "mesh_with_faces.ply"
    distances = cKDTree(read_cloud(path).points).query(sample_surface(path, 200).points)[0]
    assert 0 < np.median(distances) < 0.01  # metres; its edges are 1 cm long


def test_cloud_without_faces_cannot_be_sampled(tmp_path, points):
    write_cloud(tmp_path / "a.ply", points)
    with pytest.raises(ValueError, match="no faces"):
        sample_surface(tmp_path / "a.ply", 10)
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    with pytest.raises(ValueError, match="no mesh"):
        sample_surface(tmp_path / "a.xyz", 10)
    with pytest.raises(ValueError, match="count is 0"):
        sample_surface(tmp_path / "a.ply", 0)


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z\n1,2,3\n4,5,6\n",
        '"X","Y","Z","Class"\n1,2,3,tree\n4,5,6,car\n',
        "//X Y Z Intensity\n1 2 3 9\n4 5 6 9\n",
        "label;z [m];y [m];x [m]\na;3;2;1\nb;6;5;4\n",
        "# made by hand\n\n1\t2\t3\n4\t5\t6\n",
        "2\n1 2 3\n4 5 6\n",
        "\ufeff1, 2, 3\n4, 5, 6\n",
        "# x y z\n1 2 3\n4 5 6\n",
        "Points:0,Points:1,Points:2\n1,2,3\n4,5,6\n",
    ],
)
def test_text_layouts(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.csv").points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("suffix", [".npy", ".xyz"])
@pytest.mark.parametrize("count", [2, 3, 4, 6, 7])
def test_tables_without_names(tmp_path, points, normals, suffix, count):
    table = np.hstack((points, normals, points))[:, :count]
    if count == 4:
        table[:, 3] = np.arange(40)
    path = tmp_path / f"a{suffix}"
    np.save(path, table) if suffix == ".npy" else np.savetxt(path, table, fmt="%.17g")
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, table[:, :3])
    assert (cloud.intensity is not None) == (count == 4)
    assert (cloud.normals is not None) == (count >= 6)


@pytest.mark.parametrize("key", ["points", "P", "xyz"])
def test_npz_keys(tmp_path, points, normals, key):
    np.savez(tmp_path / "a.npz", **{key: points.astype(np.float32)}, normals=normals, other=3)
    cloud = read_cloud(tmp_path / "a.npz")
    np.testing.assert_array_equal(cloud.points, points.astype(np.float32))
    np.testing.assert_allclose(cloud.normals, normals)


@pytest.mark.parametrize("count", [6, 8])  # rows of 5 alone, and rows of 4 as well
def test_bin_of_nuscenes_has_the_number_of_the_laser(tmp_path, rng, count):
    rows = np.column_stack((rng.normal(size=(count, 3)), rng.integers(0, 255, count), np.arange(count))).astype("<f4")
    rows.tofile(tmp_path / "a.pcd.bin")
    cloud = read_cloud(tmp_path / "a.pcd.bin")
    np.testing.assert_array_equal(cloud.points, rows[:, :3])
    np.testing.assert_array_equal(cloud.intensity, rows[:, 3])


def test_bin_of_whole_numbers_and_of_a_multiple_of_five_points_is_kitti(tmp_path, rng):
    for rows in (np.arange(40.0).reshape(10, 4), rng.normal(size=(10, 4))):
        rows.astype("<f4").tofile(tmp_path / "a.bin")
        np.testing.assert_array_equal(read_cloud(tmp_path / "a.bin").points, rows[:, :3].astype("<f4"))


def test_four_columns_where_the_bytes_would_fit_six(tmp_path, rng):
    rows = rng.normal(size=(12, 4)).astype(np.float32)  # 192 bytes: 12 rows of four or 8 of six
    rows.tofile(tmp_path / "a.bin")
    cloud = read_cloud(tmp_path / "a.bin")
    np.testing.assert_array_equal(cloud.points, rows[:, :3])
    np.testing.assert_array_equal(cloud.intensity, rows[:, 3])


def test_big_endian_ply_and_vertices_behind_another_element(tmp_path, points):
    header = (
        "ply\r\nformat binary_big_endian 1.0\r\nelement camera 1\r\nproperty double f\r\n"
        "element vertex 40\r\n"
        "property float x\r\nproperty float y\r\nproperty float z\r\nend_header\r\n"
    )
    body = struct.pack(">d", 7.0) + points.astype(">f4").tobytes()
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").points, points.astype(np.float32))


def test_ply_with_mixed_polygons(tmp_path):
    text = (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty double y\nproperty double x\nproperty double z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n0 1 0\n1 1 0\n1 0 0\n3 0 1 2\n4 0 1 2 3\n"
    )
    (tmp_path / "a.ply").write_text(text)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply").points[:3], [[0, 0, 0], [1, 0, 0], [1, 1, 0]])


def test_old_pcd_with_two_blanks_in_a_row(tmp_path):
    text = "VERSION .5\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nDATA ascii\n1  2 3\n4 5  6\n"
    (tmp_path / "a.pcd").write_text(text)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.pcd").points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".csv", ".xyz"])
def test_returns_of_nothing_are_dropped_and_counted(tmp_path, points, normals, suffix):
    points = points.astype(np.float32)
    points[3, 1], points[5], points[7, 0] = np.nan, np.nan, np.inf
    write_cloud(tmp_path / f"a{suffix}", points, normals=normals, columns={"intensity": np.arange(40)})
    cloud = read_cloud(tmp_path / f"a{suffix}")
    kept = np.setdiff1d(np.arange(40), [3, 5, 7])
    assert cloud.dropped == 3
    np.testing.assert_array_equal(cloud.points.astype(np.float32), points[kept])
    np.testing.assert_array_equal(cloud.intensity, kept)
    np.testing.assert_allclose(cloud.normals, normals[kept], atol=1e-7)


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_incomplete_normals_are_none(tmp_path, points, normals, missing):
    normals[4] = missing
    write_cloud(tmp_path / "a.ply", points, normals=normals)
    assert read_cloud(tmp_path / "a.ply").normals is None


def test_normals_of_any_length_come_back_as_unit(tmp_path, points, normals):
    write_cloud(tmp_path / "a.ply", points, normals=3 * normals)
    np.testing.assert_allclose(read_cloud(tmp_path / "a.ply").normals, normals)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_las_in_map_coordinates(tmp_path, points, suffix):
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    shift = np.array([431_000.0, 5_412_000.0, 300.0])  # metres, as in UTM
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = shift, [1e-4] * 3
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points + shift).T
    las.intensity = np.arange(40)
    las.write(tmp_path / f"a{suffix}")
    cloud = read_cloud(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(cloud.points - shift, points, atol=1e-4)
    np.testing.assert_array_equal(cloud.intensity, np.arange(40))


def test_las_without_its_library_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.laz").write_bytes(b"LASF")
    monkeypatch.setattr("bbr_layer.cloud_formats.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r'not installed: pip install "laspy\[lazrs\]"'):
        read_cloud(tmp_path / "a.laz")


def test_bin_whose_fifth_numbers_are_too_large_for_lasers_is_kitti(tmp_path, rng):
    values = rng.random((4, 5)).astype(np.float32)
    values[:, 4] = 1000
    values.tofile(tmp_path / "a.bin")
    assert len(read_cloud(tmp_path / "a.bin").points) == 5


def test_the_vertices_of_a_mesh_keep_their_order(tmp_path):
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n2 0 0\n0 1 0\n1 0 1\n3 0 1 2\n")
    assert read_cloud(tmp_path / "a.off").points.tolist() == [[2, 0, 0], [0, 1, 0], [1, 0, 1]]
