"""The main job: broken off anywhere it ends like an unbroken run, and registers nothing twice."""

import numpy as np
import pytest
import torch
from small_worlds import displaced, small_config, small_world, true_edges, true_poses

from bbr_layer import read_cloud, read_poses
from train import mapping
from train.config import load_config
from train.mapping import map_scans
from train.run_folder import open_run
from train.scans import silent


class Killed(Exception):
    """Stands for the end of the process."""


def killed_at(stage, done):
    def progress(*news):
        if news[:2] == (stage, done):
            raise Killed

    return progress


class Registrar:
    """True edges and a rough start, without registration; counts how often it is asked."""

    def __init__(self):
        self.asked = 0

    def __call__(self, scans, config, progress):
        self.asked += 1
        torch.manual_seed(7)
        progress("edges", 1, 1)
        return true_edges(scans), displaced(true_poses(scans), 0.1)


CONFIG = small_config(epochs=3, term="residual", localisation_rate=0.03)


def mapped(out, register, progress=silent, **opening):
    run = open_run(out, small_world(), CONFIG, **opening)
    return map_scans(run, small_world(), CONFIG, register=register, progress=progress)


@pytest.fixture
def poses_only(monkeypatch):
    """Leaves the pictures out, which take longer than all the rest."""

    def write(out, result, progress):
        progress("writing", 0, 1)
        np.savez(out / "poses.npz", poses=result.world_from_scan)

    monkeypatch.setattr(mapping, "write_outputs", write)


@pytest.mark.parametrize(
    ("stage", "done", "registered"),
    [("edges", 1, 2), ("training", 1, 1), ("training", 2, 1), ("training", 3, 1), ("writing", 0, 1)],
)
@pytest.mark.usefixtures("poses_only")
def test_a_killed_run_resumes_to_the_same_bits(tmp_path, stage, done, registered):
    whole = mapped(tmp_path / "whole", Registrar())
    register = Registrar()
    with pytest.raises(Killed):
        mapped(tmp_path / "killed", register, killed_at(stage, done))
    assert not (tmp_path / "killed" / "poses.npz").exists()
    resumed = mapped(tmp_path / "killed", register, resume=True)
    assert register.asked == registered
    assert np.array_equal(resumed.result.world_from_scan, whole.result.world_from_scan)
    assert resumed.result.losses == whole.result.losses
    assert torch.equal(resumed.start.matrix, whole.start.matrix)
    places = np.random.default_rng(0).uniform(-5, 5, size=(50, 2))
    assert np.array_equal(resumed.result.occupancy(places), whole.result.occupancy(places))


@pytest.mark.usefixtures("poses_only")
def test_another_training_on_the_same_edges(tmp_path):
    register = Registrar()
    mapped(tmp_path, register)
    other = small_config(epochs=1, term="chamfer")
    run = open_run(tmp_path, small_world(), other, resume=True)
    result = map_scans(run, small_world(), other, register=register).result
    assert register.asked == 1
    assert len(result.losses["total"]) == 1


@pytest.mark.parametrize("dimension", [2, 3])
def test_registered_scans_become_a_map(tmp_path, dimension):
    scans, config = small_world(dimension), small_config()
    run = open_run(tmp_path, scans, config)
    done = map_scans(run, scans, config, unit="m")
    assert np.linalg.norm(done.result.positions - scans.truth[:, :-1, -1], axis=1).max() < 0.3
    names = "poses_tum.txt poses.npz map.ply trajectory.png map.png occupancy.png occupancy.yaml map.html metrics.json"
    for name in names.split() + ["poses_kitti.txt"] * (dimension == 3):
        assert (tmp_path / name).stat().st_size > 0
    poses = read_poses(tmp_path / "poses_tum.txt")
    np.testing.assert_allclose(poses[:, :dimension, 3], done.result.positions, atol=1e-6)
    parts = [path for path in (tmp_path / "map.ply", tmp_path / "movers.ply") if path.exists()]
    assert sum(len(read_cloud(path).points) for path in parts) == sum(map(len, scans.points))
    assert load_config(tmp_path / "config.yaml") == config
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
