"""What of a run lies in its folder: what stays for the next one, what goes, and what is not touched unasked."""

import dataclasses

import numpy as np
import pytest
from small_worlds import small_config, small_world

from train.checkpoints import LAST
from train.run_folder import EDGES, MAP_FILES, open_run


class Killed(Exception):
    """Stands for the end of the process."""


@pytest.fixture
def opened(tmp_path):
    """Opens one folder, with files in it as a finished run leaves them."""

    def opening(scans, config, *, finished=True, **settings):
        run = open_run(tmp_path, scans, config, **settings)
        seen = run.registered, run.begun
        (tmp_path / "edges.npz").write_text("edges")
        (tmp_path / "checkpoints" / LAST).write_text("training")
        if finished:
            (tmp_path / "poses.npz").write_text("a map")
        return seen

    return opening


def test_a_folder_with_another_map_is_refused(tmp_path, opened):
    opened(small_world(), small_config())
    assert opened(small_world(), small_config()) == (False, False)
    with pytest.raises(ValueError, match="holds a map made from other training: give another folder"):
        opened(small_world(), small_config(term="chamfer"))
    with pytest.raises(ValueError, match="made from other scans and edges"):
        opened(small_world(3), small_config(), origin="poses")
    (tmp_path / "checkpoints" / "run.json").write_text("damaged")
    with pytest.raises(ValueError, match="made from unknown settings"):
        opened(small_world(), small_config())
    assert (tmp_path / "edges.npz").exists()


@pytest.mark.parametrize("name", ["logs/mine.log", "checkpoints/mine.ckpt", "edges.npz", "poses.npz"])
@pytest.mark.parametrize("resume", [False, True])
def test_files_that_no_run_left_are_deleted_only_when_asked(tmp_path, name, resume):
    mine = tmp_path / name
    mine.parent.mkdir(exist_ok=True)
    mine.write_text("mine")
    (tmp_path / "checkpoints").mkdir(exist_ok=True)
    with pytest.raises(ValueError, match=rf"holds {name.split('/')[0]} but no .* or --overwrite to delete it"):
        open_run(tmp_path, small_world(), small_config(), resume=resume)
    assert mine.read_text() == "mine"
    open_run(tmp_path, small_world(), small_config(), overwrite=True)
    assert not mine.exists()
    open_run(tmp_path, small_world(), small_config())


def test_a_run_killed_while_its_folder_is_cleared_is_still_known_as_one(tmp_path, opened, monkeypatch):
    opened(small_world(), small_config())

    def killed(path):
        raise Killed

    monkeypatch.setattr("train.run_folder.atomic_write", killed)
    with pytest.raises(Killed):
        open_run(tmp_path, small_world(), small_config())
    monkeypatch.undo()
    assert not (tmp_path / "checkpoints" / LAST).exists()
    open_run(tmp_path, small_world(), small_config(), resume=True)


@pytest.mark.parametrize("asked", ["resume", "overwrite"])
def test_a_map_of_something_else_does_not_stand_beside_the_new_run(tmp_path, opened, asked):
    opened(small_world(), small_config())
    for name in (*MAP_FILES, "config.yaml", "map.csv"):
        (tmp_path / name).write_text("of the first run, or mine")
    open_run(tmp_path, small_world(), small_config(), **{asked: True})
    assert all((tmp_path / name).exists() for name in MAP_FILES), "the same run again replaces them when it is done"
    open_run(tmp_path, small_world(), small_config(term="chamfer"), **{asked: True})
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} - {EDGES} == {"config.yaml", "map.csv"}


def test_files_that_only_look_like_a_map_stay(tmp_path):
    (tmp_path / "map.png").write_text("mine")
    open_run(tmp_path, small_world(), small_config())
    assert (tmp_path / "map.png").exists()


def test_an_unfinished_run_of_other_settings_is_replaced(tmp_path, opened):
    opened(small_world(), small_config(), finished=False)
    open_run(tmp_path, small_world(), small_config(term="chamfer"))
    assert not (tmp_path / "edges.npz").exists()
    assert not (tmp_path / "checkpoints" / LAST).exists()


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({}, (True, True)),
        ({"training": {"term": "chamfer"}}, (True, False)),
        ({"seed": 1}, (True, False)),
        ({"edges": {"window": 2}}, (False, False)),
        ({"device": "auto"}, (True, True)),
    ],
)
def test_resume_keeps_what_fits(tmp_path, opened, change, kept):
    opened(small_world(), small_config())
    config = small_config().model_copy(update={"seed": change.get("seed", 0), "device": change.get("device", "cpu")})
    for section in ("edges", "training"):
        updated = getattr(config, section).model_copy(update=change.get(section, {}))
        config = config.model_copy(update={section: updated})
    run = open_run(tmp_path, small_world(), config, resume=True)
    assert (run.registered, run.begun) == kept
    assert (tmp_path / "edges.npz").exists() == kept[0]
    assert (tmp_path / "checkpoints" / LAST).exists() == kept[1]


def test_resume_looks_at_the_points(opened):
    opened(small_world(), small_config())
    scans = small_world()
    moved = dataclasses.replace(scans, points=[points + np.float64(1e-6) for points in scans.points])
    assert opened(moved, small_config(), resume=True) == (False, False)
