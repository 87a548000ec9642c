"""Simulated worlds as files: what was simulated, whole or not at all."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from simulated_worlds import simulate, small

from bbr_layer import read_poses_tum, read_scans
from train.simulate import WorldSettings
from train.simulation_files import write_simulation


@pytest.mark.parametrize("dimension", [2, 3])
def test_files_hold_what_was_simulated(dimension, tmp_path):
    simulated = simulate(small(dimension, movers=2))
    write_simulation(tmp_path / "new" / "run", simulated)
    scans = read_scans(tmp_path / "new" / "run")
    assert len(scans) == 20
    for scan, points in zip(scans, simulated.points, strict=True):
        np.testing.assert_array_equal(scan.points[:, :dimension], points)
        assert dimension == 3 or not scan.points[:, 2].any()
    timestamps, truth = read_poses_tum(tmp_path / "new" / "run" / "truth_tum.txt")
    np.testing.assert_allclose(truth, simulated.world_from_scan, atol=1e-9)
    np.testing.assert_allclose(timestamps, simulated.timestamps)
    world = trimesh.load_mesh(tmp_path / "new" / "run" / "world" / "world.ply")
    np.testing.assert_allclose(world.bounds, simulated.world.bounds, atol=1e-5)
    written = yaml.safe_load((tmp_path / "new" / "run" / "settings.yaml").read_text())
    assert WorldSettings(**written) == simulated.settings
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["run"]


def test_an_earlier_simulation_is_replaced_whole(tmp_path):
    write_simulation(tmp_path / "run", simulate(small(scans=12)))
    write_simulation(tmp_path / "run", simulate(small(scans=5)))
    assert len(read_scans(tmp_path / "run")) == 5
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


@pytest.mark.parametrize("stranger", ["notes.txt", "007.ply"])
def test_a_folder_of_other_files_is_left_alone(tmp_path, stranger):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / stranger).write_text("mine")
    with pytest.raises(ValueError, match="holds other files than a simulation's .*give a new folder"):
        write_simulation(tmp_path / "run", simulate(small(scans=2)))
    assert (tmp_path / "run" / stranger).read_text() == "mine"
    assert len(list((tmp_path / "run").iterdir())) == 1


def test_a_file_or_a_place_that_cannot_be_written_is_one_clear_sentence(tmp_path):
    simulated = simulate(small(scans=2))
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match="is a file; give the name of a folder"):
        write_simulation(tmp_path / "file", simulated)
    with pytest.raises(OSError, match="cannot be written .*choose another folder"):
        write_simulation(tmp_path / "file" / "run", simulated)


def test_nothing_is_left_of_a_simulation_that_could_not_be_written_whole(tmp_path, monkeypatch):
    simulated = simulate(small(scans=3))
    write_simulation(tmp_path / "run", simulated)

    def full_disk(*_, **__):
        raise OSError("no space left")

    monkeypatch.setattr("train.simulation_files.write_poses_tum", full_disk)
    with pytest.raises(OSError, match="no space left"):
        write_simulation(tmp_path / "run", simulate(small(scans=2)))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert len(read_scans(tmp_path / "run")) == 3


def test_an_earlier_simulation_comes_back_when_the_new_one_cannot_take_its_place(tmp_path, monkeypatch):
    write_simulation(tmp_path / "run", simulate(small(scans=3)))
    rename = Path.rename

    def refused(self, target):
        if (self / "000.ply").exists() and not (self / "002.ply").exists():
            raise OSError("device busy")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refused)
    with pytest.raises(OSError, match="device busy"):
        write_simulation(tmp_path / "run", simulate(small(scans=2)))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert len(read_scans(tmp_path / "run")) == 3
