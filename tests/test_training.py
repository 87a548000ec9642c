"""The training as a whole: never worse than its start, and the same answer however often it was broken off."""

import os
import signal

import pytest
import torch
from small_worlds import displaced, small_config, small_world, true_edges, true_poses

from bbr_layer import RigidMotion
from train.alignment import Alignment
from train.checkpoints import LAST
from train.data_module import prepare_scan
from train.keep_best import SCORE
from train.settling import MOVED, trajectory_change
from train.surface_map import MapScore, SurfaceMap
from train.training import Stopped, train_map

# Settings under which few epochs bring displaced poses of the small world closer.
HELPFUL = {"term": "residual", "localisation_rate": 0.03}


class Killed(Exception):
    """Stands for the end of the process."""


def killed_after(epoch):
    def progress(stage, done, total):
        if (stage, done) == ("training", epoch):
            raise Killed

    return progress


def weights(trained):
    return torch.cat([p.flatten() for p in trained.module.model.parameters()])


@pytest.mark.parametrize("adjust", [False, True])
@pytest.mark.parametrize("epoch", [1, 3, 5])
def test_a_killed_training_goes_on_to_the_same_bits(tmp_path, epoch, adjust):
    scans = small_world()
    config = small_config(epochs=5, points=40, warm_up=0.2, settle=0.2, adjust=adjust, **HELPFUL)
    problem = (scans, true_edges(scans), displaced(true_poses(scans), 0.1), config)
    whole = train_map(*problem, folder=tmp_path / "whole")
    with pytest.raises(Killed):
        train_map(*problem, folder=tmp_path / "killed", progress=killed_after(epoch))
    assert (tmp_path / "killed" / "checkpoints" / LAST).is_file() == (epoch > 1), "an epoch is kept once it is over"
    told = []
    resumed = train_map(*problem, folder=tmp_path / "killed", progress=lambda *news: told.append(news))
    assert [done for stage, done, _ in told if stage == "training"] == list(range(epoch, 6))
    assert torch.equal(resumed.world_from_scan.matrix, whole.world_from_scan.matrix)
    assert torch.equal(weights(resumed), weights(whole))
    assert resumed.curves == whole.curves
    assert resumed.kept_epoch == whole.kept_epoch
    assert (whole.kept_epoch > 0) == (not adjust), "after the adjustment no epoch is better here"
    assert [len(curve) for curve in whole.curves.values()] == [6, 5, 5, 5, 5]


@pytest.fixture
def own_interrupt():
    """Ctrl-C as Python has it: a process that a shell started in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
@pytest.mark.parametrize("epoch", [2, 3])
def test_a_training_that_a_signal_stops_says_so_and_goes_on_to_the_same_bits(
    tmp_path, number, code, epoch, own_interrupt
):
    scans = small_world()
    problem = scans, true_edges(scans), displaced(true_poses(scans), 0.1), small_config(epochs=3, points=20)
    handlers = [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGINT)]

    def stopping(stage, done, total):
        if (stage, done) == ("training", epoch):
            os.kill(os.getpid(), number)

    with pytest.raises(Stopped, match=f"{number.name} stopped the training .* --resume goes on") as stopped:
        train_map(*problem, folder=tmp_path, progress=stopping)
    assert stopped.value.code == code
    assert [signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGINT)] == handlers
    assert (tmp_path / "checkpoints" / LAST).is_file()
    resumed, whole = train_map(*problem, folder=tmp_path), train_map(*problem)
    assert torch.equal(weights(resumed), weights(whole))
    assert resumed.curves == whole.curves


def test_a_finished_training_is_not_done_again(tmp_path):
    scans = small_world()
    problem = (scans, true_edges(scans), displaced(true_poses(scans), 0.1), small_config())
    first = train_map(*problem, folder=tmp_path)
    told = []
    again = train_map(*problem, folder=tmp_path, progress=lambda *news: told.append(news))
    assert {stage for stage, *_ in told} == {"adjustment"}
    assert torch.equal(again.world_from_scan.matrix, first.world_from_scan.matrix)
    assert again.curves == first.curves


@pytest.mark.parametrize("epoch", [4, 5, 7])
def test_poses_that_no_longer_move_settle_early_however_often_it_was_broken_off(tmp_path, epoch):
    scans = small_world()
    config = small_config(epochs=20, points=20, warm_up=0.1, settle=0.2, localisation_rate=1e-6, adjust=False)
    problem = scans, true_edges(scans), displaced(true_poses(scans), 0.1), config
    whole = train_map(*problem)
    # Two epochs to warm up, three of rest, one whose rate is set by then, four to settle.
    assert len(whole.curves["total"]) == len(whole.curves[MOVED]) == 10
    with pytest.raises(Killed):
        train_map(*problem, folder=tmp_path, progress=killed_after(epoch))
    resumed = train_map(*problem, folder=tmp_path)
    again = train_map(*problem, folder=tmp_path)
    for trained in (resumed, again):
        assert torch.equal(weights(trained), weights(whole))
        assert trained.curves == whole.curves


def test_the_change_of_a_trajectory_counts_turns_at_the_points():
    still = RigidMotion.identity(2, (2,))
    moved = RigidMotion.from_rotvec(
        torch.tensor([[0.0], [0.1]]).double(), torch.tensor([[3.0, 4.0], [0.0, 0.0]]).double()
    )
    assert trajectory_change(still, moved, torch.tensor([1.0, 20.0]).double()) == pytest.approx(((25 + 4) / 2) ** 0.5)
    assert trajectory_change(moved, moved, torch.ones(2).double()) < 1e-12


def test_without_a_folder_nothing_is_written_and_the_answer_is_the_same(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scans = small_world()
    problem = (scans, true_edges(scans), displaced(true_poses(scans), 0.1), small_config())
    without = train_map(*problem)
    assert list(tmp_path.iterdir()) == []
    assert torch.equal(weights(without), weights(train_map(*problem, folder=tmp_path)))


def test_the_best_epoch_is_kept():
    scans, edges = small_world(), true_edges(small_world())
    start = displaced(true_poses(scans), 0.1)
    trained = train_map(scans, edges, start, small_config(epochs=6, warm_up=0, settle=0, adjust=False, **HELPFUL))
    prepared = [prepare_scan(points, 64) for points in scans.points]
    score = MapScore(Alignment(prepared, edges), SurfaceMap(scans, prepared, start.matrix.numpy()))
    assert trained.kept_epoch > 0
    assert trained.curves[SCORE][0] == pytest.approx(score(start))
    assert trained.curves[SCORE][trained.kept_epoch] == pytest.approx(score(trained.world_from_scan))
    assert score(trained.world_from_scan) < score(start)


def test_the_training_begins_at_the_adjusted_poses():
    scans, edges = small_world(), true_edges(small_world())
    start = displaced(true_poses(scans), 0.01)
    adjusted = train_map(scans, edges, start, small_config(epochs=2, warm_up=0.5, settle=0.5))
    as_given = train_map(scans, edges, start, small_config(epochs=2, warm_up=0.5, settle=0.5, adjust=False))
    assert adjusted.kept_epoch == as_given.kept_epoch == 0
    assert torch.equal(as_given.world_from_scan.matrix, start.matrix)
    assert adjusted.curves[SCORE][0] < as_given.curves[SCORE][0]
    off = [(poses.world_from_scan.matrix - true_poses(scans).matrix).norm() for poses in (adjusted, as_given)]
    assert off[0] < 0.75 * off[1]


def test_a_training_that_only_harms_ends_at_its_start():
    scans = small_world()
    config = small_config(epochs=6, term="chamfer", localisation_rate=1.0, warm_up=0, settle=0.5, adjust=False)
    start = true_poses(scans)
    trained = train_map(scans, true_edges(scans), start, config)
    assert trained.kept_epoch == 0
    assert max(trained.curves[SCORE]) > 1.2 * trained.curves[SCORE][0]
    assert torch.equal(trained.world_from_scan.matrix, start.matrix)
    assert trained.curves[SCORE][-1] == trained.curves[SCORE][0], "the settling phase moved poses"


def test_the_last_epoch_is_kept_where_that_is_asked_for():
    scans = small_world()
    harmful = {"term": "chamfer", "localisation_rate": 1.0, "warm_up": 0, "settle": 0.5, "adjust": False}
    start = true_poses(scans)
    trained = train_map(scans, true_edges(scans), start, small_config(epochs=6, keep="last", **harmful))
    assert trained.kept_epoch == 6
    assert not torch.equal(trained.world_from_scan.matrix, start.matrix)
    moved = trained.curves[SCORE]
    assert moved[-1] > 1.2 * moved[0]
    assert moved[3:] == [moved[3]] * 4, "the settling phase moved poses"


def test_no_epochs_keep_the_start(tmp_path):
    scans = small_world()
    start = displaced(true_poses(scans), 0.1)
    trained = train_map(scans, true_edges(scans), start, small_config(epochs=0), folder=tmp_path)
    assert torch.equal(trained.world_from_scan.matrix, start.matrix)
    assert trained.kept_epoch == 0 and trained.curves == {}


def test_fast_dev_run(tmp_path):
    scans = small_world()
    trained = train_map(scans, true_edges(scans), true_poses(scans), small_config(), folder=tmp_path, fast_dev_run=True)
    assert len(trained.curves["total"]) == 1
    assert list(tmp_path.iterdir()) == []


def test_logs_for_people_and_programs(tmp_path):
    scans = small_world()
    train_map(scans, true_edges(scans), true_poses(scans), small_config(), folder=tmp_path)
    lines = (tmp_path / "logs" / "csv" / "version_0" / "metrics.csv").read_text().splitlines()
    assert {"epoch", SCORE, MOVED, "loss/total", "loss/occupancy", "loss/registration"} <= set(lines[0].split(","))
    assert len(lines) == 3
    assert list((tmp_path / "logs" / "tensorboard" / "version_0").glob("events*"))


def test_an_epoch_is_held_against_the_best_one_so_far(monkeypatch):
    values = iter([1.0, 0.5, 0.8])
    monkeypatch.setattr("train.training.MapScore", lambda *parts: lambda poses: next(values))
    scans = small_world()
    trained = train_map(scans, true_edges(scans), true_poses(scans), small_config(warm_up=0, settle=0, adjust=False))
    assert trained.kept_epoch == 1
