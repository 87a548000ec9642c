"""Damaged and wrong cloud files, each told in one sentence."""

import numpy as np
import pytest

from bbr_layer import read_cloud, read_scans, write_cloud


@pytest.fixture
def points(rng):
    return rng.normal(size=(40, 3))


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".npz", ".npy", ".bin"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.5, 0.97])
def test_files_cut_short(tmp_path, points, suffix, share):
    path = tmp_path / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, points)
    elif suffix == ".bin":
        np.hstack((points, points[:, :1])).astype("<f4").tofile(path)
    else:
        write_cloud(path, points)
    whole = path.read_bytes()
    cut = int(share * len(whole))
    path.write_bytes(whole[: cut + (suffix == ".bin" and cut % 8 == 0 and cut > 0)])
    with pytest.raises(ValueError, match=f"a{suffix} ") as caught:
        read_cloud(path)
    assert "\n" not in str(caught.value)


def test_text_files_cut_short_or_garbled(tmp_path):
    for text in (
        "x y z\n1 2 3\n4 5",
        "1,2,3\n4,five,6\n",
        "title\nsubtitle\n1 2 3\n",
        "",
        "7\n",
        "\x00\x01\x02",
    ):
        (tmp_path / "a.csv").write_text(text)
        with pytest.raises(ValueError, match=r"a\.csv "):
            read_cloud(tmp_path / "a.csv")


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".off", ".las", ".ply", ".pcd", ".npz"])
@pytest.mark.parametrize("content", [b"", b"hello world", bytes(range(256)) * 4])
def test_files_that_are_something_else(tmp_path, suffix, content):
    if suffix == ".las":
        pytest.importorskip("laspy")
    (tmp_path / f"a{suffix}").write_bytes(content)
    with pytest.raises(ValueError, match=f"a{suffix} "):
        read_cloud(tmp_path / f"a{suffix}")


def test_a_header_that_promises_more_than_memory_holds(tmp_path):
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 9000000000000000\n"
    (tmp_path / "a.ply").write_bytes(header + b"property float x\nproperty float y\nend_header\n1234")
    with pytest.raises(ValueError, match=r"a\.ply cannot be read"):
        read_cloud(tmp_path / "a.ply")


def test_what_is_no_cloud_file(tmp_path, points):
    (tmp_path / "a.jpeg").write_bytes(b"1")
    np.savez(tmp_path / "a.npz", src=points, tgt=points)
    np.save(tmp_path / "complex.npy", points.astype(complex))
    (tmp_path / "b.csv").write_text("t,u,v\n1,2,3\n")
    (tmp_path / "nan.xyz").write_text("nan nan nan\nnan 1 2\n")
    for name, error, words in (
        ("none.ply", FileNotFoundError, "does not exist"),
        (".", ValueError, "is a folder"),
        ("a.jpeg", ValueError, r"suffix '.jpeg'; readable are .ply"),
        ("a.npz", ValueError, "src, tgt; an array named points"),
        ("complex.npy", ValueError, "complex128 numbers; coordinates are real"),
        ("b.csv", ValueError, "neither numbers nor a header"),
        ("nan.xyz", ValueError, r"no finite point \(2 in all\)"),
    ):
        with pytest.raises(error, match=words):
            read_cloud(tmp_path / name)


def test_sequences_with_wrong_offsets(tmp_path, points):
    ends = "rise from 0 to the number of points, 40"
    for offsets, words in (
        (np.array([0, 20, 41]), ends),
        (np.array([0, 30, 20, 40]), ends),
        (np.array([0, 20, 40], dtype=np.uint8)[::-1], ends),
        (np.array([0.0, 20.5, 40.0]), "float64 of shape"),
        (np.array(0), r"int64 of shape \(\)"),
        (np.array([], dtype=int), r"int64 of shape \(0,\)"),
        (np.zeros((2, 2), dtype=int), r"int64 of shape \(2, 2\)"),
    ):
        np.savez(tmp_path / "a.npz", points=points, offsets=offsets)
        with pytest.raises(ValueError, match=words):
            read_scans(tmp_path / "a.npz")
    for wrong, words in ((points[:, 0], r"shape \(40,\)"), (points.astype(complex), "coordinates are real")):
        np.savez(tmp_path / "a.npz", points=wrong, offsets=np.array([0, 20, 40]))
        with pytest.raises(ValueError, match=words):
            read_scans(tmp_path / "a.npz")
    np.savez(tmp_path / "a.npz", points=points)
    with pytest.raises(ValueError, match="no .npz of several scans"):
        read_scans(tmp_path / "a.npz")
