"""Files are written whole or not at all."""

import os

import numpy as np
import pytest

from bbr_layer import atomic_write, write_cloud


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="midway"), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError("midway")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_link_keeps_pointing_at_its_file(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    with atomic_write(tmp_path / "link.txt") as temporary:
        assert temporary.suffix == ".txt"
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_unwritable_places(tmp_path, monkeypatch):
    points = np.zeros((2, 3))
    with pytest.raises(FileNotFoundError, match="is not a folder; create it first"):
        write_cloud(tmp_path / "nowhere" / "a.ply", points)
    (tmp_path / "folder.ply").mkdir()
    with pytest.raises(OSError, match="a folder or a device"):
        write_cloud(tmp_path / "folder.ply", points)

    def refuse(path, **_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.touch", refuse)  # tests may run as root, whom nothing is refused
    with pytest.raises(PermissionError, match=r"a\.ply cannot be written \(Permission denied\): choose another"):
        write_cloud(tmp_path / "a.ply", points)
    assert os.listdir(tmp_path) == ["folder.ply"]
