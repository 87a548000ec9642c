"""The command line of the mapper: from nothing to a map, on from where it stopped, and what bad input is told."""

import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from bbr_layer import read_cloud, read_poses, write_cloud, write_poses_tum
from train.__main__ import app
from train.beforehand import PRESENT
from train.config import load_config
from train.console import _kept_sentence

FAST = ("--epochs", "2")


def run(*arguments):
    return CliRunner().invoke(app, list(map(str, arguments)), catch_exceptions=False)


def refused(*arguments):
    """The sentence on stderr of a call that must end with exit code 2."""
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1
    assert "Traceback" not in result.output
    return result.stderr


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder of eight simulated scans."""
    folder = tmp_path_factory.mktemp("simulated") / "world"
    result = run("simulate", folder, "--scans", 8, "--beams", 64)
    assert result.exit_code == 0
    assert str(folder / "truth_tum.txt") in result.stdout
    return folder


@pytest.fixture(scope="module")
def finished(world, tmp_path_factory):
    """A folder with a finished map, and what was printed."""
    out = tmp_path_factory.mktemp("finished") / "map"
    result = run("map", world, "--out", out, "--truth", world / "truth_tum.txt", *FAST, "--unit", "m")
    assert result.exit_code == 0, result.output
    return out, result.stdout


def test_a_map_says_where_it_is_and_how_good(finished):
    out, printed = finished
    for name in ("poses_tum.txt", "map.ply", "map.html", "map.png", "trajectory.png", "occupancy.png", "metrics.json"):
        assert str(out / name) in printed and (out / name).stat().st_size > 0
    error = float(re.search(r"ape_rmse +(\S+) m", printed).group(1))
    metrics = json.loads((out / "metrics.json").read_text())
    assert error == pytest.approx(metrics["trajectory"]["ape_rmse"], rel=1e-3) and error < 0.3
    assert "Kept " in printed
    assert load_config(out / "config.yaml").training.epochs == 2


def test_whose_poses_were_kept_is_said_as_it_is():
    assert _kept_sentence(0, [1.0, 2.0], False) == "Kept the edges' map: no epoch of 1 scores better (1.0000)."
    assert "the edges' map, adjusted to all scans at once" in _kept_sentence(0, [1.0, 2.0], True)
    assert _kept_sentence(1, [2.0, 1.0], False) == "Kept epoch 1 of 1: score 1.0000, the starting map 2.0000."


def test_evaluate_gives_the_same_errors(finished, world):
    out, _ = finished
    result = run("evaluate", out / "poses_tum.txt", world / "truth_tum.txt", "--json")
    errors, metrics = json.loads(result.stdout), json.loads((out / "metrics.json").read_text())["trajectory"]
    assert errors["ape_rmse"] == pytest.approx(metrics["ape_rmse"], rel=1e-4)
    printed = run("evaluate", out / "poses_tum.txt", world / "truth_tum.txt", "--unit-scale", 512, "--unit", "px")
    assert float(re.search(r"ape_max +(\S+) px", printed.stdout).group(1)) == pytest.approx(
        512 * errors["ape_max"], rel=1e-3
    )


def test_resuming_a_finished_map_changes_no_pose(finished, world):
    out, _ = finished
    before = read_poses(out / "poses.npz")
    result = run("map", world, "--out", out, *FAST, "--resume")
    assert result.exit_code == 0
    assert "window" not in result.stdout, "edges were registered again"
    assert np.array_equal(read_poses(out / "poses.npz"), before)


def test_another_map_is_not_overwritten_unasked(finished, world):
    out, _ = finished
    assert "--overwrite" in refused("map", world, "--out", out, "--term", "chamfer", *FAST)
    assert load_config(out / "config.yaml").training.term != "chamfer"


def test_fit_trains_from_known_poses(finished, world, tmp_path):
    out, _ = finished
    poses, edges = world / "truth_tum.txt", out / "edges.npz"
    result = run("fit", world, "--poses", poses, "--edges", edges, "--term", "residual", "--out", tmp_path / "a", *FAST)
    assert result.exit_code == 0, result.output
    assert read_poses(tmp_path / "a" / "poses.npz")[0] == pytest.approx(read_poses(poses)[0])
    sentence = refused("fit", world, "--poses", poses, "--term", "residual", "--out", tmp_path / "b")
    assert "give --edges" in sentence and not (tmp_path / "b").exists()


def test_what_was_left_out_of_the_scans_is_printed_and_kept(world, tmp_path):
    shutil.copytree(world, tmp_path / "scans")
    points = read_cloud(world / "002.ply").points
    write_cloud(tmp_path / "scans" / "002.ply", np.concatenate((points, [[65535.0, 0.0, 0.0]])))
    result = run("map", tmp_path / "scans", "--out", tmp_path / "out", "--epochs", 0)
    assert result.exit_code == 0, result.output
    assert "Note: points that lie farther than" in result.stdout and "1 in 002.ply" in result.stdout
    assert "1 in 002.ply" in json.loads((tmp_path / "out" / "metrics.json").read_text())["notes"][0]


def test_without_scans_a_world_is_simulated(tmp_path):
    result = run("map", "--out", tmp_path / "out", "--stride", 8, "--epochs", 0)
    assert result.exit_code == 0, result.output
    assert len(list((tmp_path / "out" / "world").glob("*.ply"))) == 64
    assert len(read_poses(tmp_path / "out" / "poses_tum.txt")) == 8
    assert "ape_rmse" in result.stdout and (tmp_path / "out" / "map.png").is_file()


@pytest.fixture
def wrong(world, tmp_path):
    """Inputs that cannot be used."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("a file")
    (tmp_path / "short").mkdir()
    for name in ("000.ply", "001.ply"):
        (tmp_path / "short" / name).write_bytes((world / name).read_bytes())
    (tmp_path / "short" / "001.ply").write_bytes((world / "001.ply").read_bytes()[:300])
    (tmp_path / "key.yaml").write_text("training:\n  epoch: 3\n")
    write_poses_tum(tmp_path / "seven.txt", np.tile(np.eye(4), (7, 1, 1)), np.arange(7.0))
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["{wrong}/empty"], "holds no scans"),
        (["{wrong}/missing"], "missing"),
        (["{wrong}/short"], "001.ply"),
        (["{world}", "--config", "{wrong}/key.yaml"], "training.epoch is no setting"),
        (["{world}", "--config", "{wrong}/none.yaml"], "no such configuration file"),
        (["{world}", "--truth", "{wrong}/seven.txt"], "holds 7 poses; the scans need 8"),
        (["{world}", "--start", "{wrong}/seven.txt"], "holds 7 poses; the scans need 8"),
        (["{world}", "--term", "icp"], "training.term is 'icp': it must be one of"),
        (["{world}", "--device", "tpu"], "device is 'tpu'"),
        (["{world}", "--device", "mps"], "device is 'mps', which torch does not find"),
        (["{world}", "--seed", str(2**32)], "seed is 4294967296: input should be less than 4294967296"),
        (["{world}", "--stride", "8"], "needs at least 2"),
        (["--start", "{wrong}/seven.txt"], "poses were given without scans"),
    ],
)
def test_bad_input_is_told_and_nothing_is_written(wrong, world, arguments, words, monkeypatch):
    monkeypatch.setitem(PRESENT, "mps", lambda: False)
    filled = [word.format(wrong=wrong, world=world) for word in arguments]
    assert words in refused("map", *filled, "--out", wrong / "out")
    assert not (wrong / "out").exists()


@pytest.mark.parametrize("command", ["map", "fit"])
def test_the_folder_of_the_scans_is_no_output(world, tmp_path, command):
    poses = ("--poses", world / "truth_tum.txt") if command == "fit" else ()
    before = sorted(world.iterdir())
    assert "where map.ply would be read as a scan" in refused(command, world, *poses, "--out", world / ".")
    assert sorted(world.iterdir()) == before
    shutil.copytree(world, tmp_path / "kitti" / "velodyne")
    sentence = refused(command, tmp_path / "kitti", *poses, "--out", tmp_path / "kitti" / "velodyne")
    assert "the folder of the scans" in sentence


@pytest.mark.parametrize(("option", "name"), [("--edges", "edges.npz"), ("--poses", "poses_tum.txt")])
def test_what_a_run_is_given_does_not_lie_where_it_would_be_replaced(world, tmp_path, option, name):
    given = {"--poses": world / "truth_tum.txt", option: tmp_path / name}
    shutil.copy(world / "truth_tum.txt", tmp_path / name)
    arguments = [x for pair in given.items() for x in pair]
    sentence = refused("fit", world, *arguments, "--out", tmp_path / ".", "--overwrite")
    assert f"{name} is a part of the run in" in sentence and "give another folder as out" in sentence
    assert [x.name for x in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("command", ["map", "simulate"])
def test_an_output_that_cannot_be_written(wrong, world, command):
    out = wrong / "file" / "out"
    arguments = ["map", world, "--out", out] if command == "map" else ["simulate", out, "--scans", 2]
    assert "cannot be written" in refused(*arguments)


def test_evaluate_refuses_poses_of_other_scans(as_a_user, wrong, world):
    assert "8 poses" in refused("evaluate", world / "truth_tum.txt", wrong / "seven.txt")


def test_simulate_refuses_what_it_cannot_do(tmp_path):
    assert "dimension is 4" in refused("simulate", tmp_path / "w", "--dimension", 4)
    assert "scans is 1" in refused("simulate", tmp_path / "w", "--scans", 1)
    assert not (tmp_path / "w").exists()


def test_the_module_runs_and_says_what_it_can():
    result = subprocess.run([sys.executable, "-m", "train", "--help"], capture_output=True, text=True, check=True)
    assert all(command in result.stdout for command in ("map", "fit", "simulate", "evaluate"))
