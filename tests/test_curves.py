"""Trajectory and loss pictures: what is plotted is what was measured."""

import numpy as np
import pytest
from map_problems import room_result

from train.curves import losses_picture, trajectory_picture
from train.drawing import round_down, save_picture
from train.evaluate import pose_errors


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr("train.drawing.DPI", 40)


def curve(axes) -> np.ndarray:
    return axes.lines[0].get_ydata()


@pytest.mark.parametrize("d", [2, 3])
def test_with_truth_the_curves_are_the_errors(d):
    result = room_result(d, k=12)
    figure = trajectory_picture(result.world_from_scan, result.scans.truth, "m")
    plan, position, rotation = figure.axes[:3]
    expected = pose_errors(result.world_from_scan, result.scans.truth)
    np.testing.assert_allclose(curve(position), expected[0])
    np.testing.assert_allclose(curve(rotation), expected[1])
    assert position.get_ylabel() == "position error (m)" and rotation.get_ylabel() == "rotation error (deg)"
    assert "truth" in {text.get_text() for text in plan.get_legend().get_texts()}


def test_the_truth_is_drawn_in_the_frame_of_the_map():
    result = room_result(error=0.0)
    turned = np.array([[0, -1, 5], [1, 0, 7], [0, 0, 1.0]]) @ result.world_from_scan
    plan = trajectory_picture(turned, result.scans.truth, "m").axes[0]
    (truth,) = (line for line in plan.lines if line.get_label() == "truth")
    np.testing.assert_allclose(truth.get_xydata(), turned[:, :2, 2], atol=1e-9)
    np.testing.assert_allclose(np.array(plan.collections[1].get_segments())[:, 0], turned[:-1, :2, 2])


def test_without_truth_the_curves_are_steps_and_turns():
    poses = np.tile(np.eye(3), (4, 1, 1))
    poses[:, 0, 2] = [0, 1, 3, 3]
    poses[3, :2, :2] = [[0, -1], [1, 0]]
    _, step, turn = trajectory_picture(poses, None, "px").axes[:3]
    np.testing.assert_allclose(curve(step), [0, 1, 2, 0])
    np.testing.assert_allclose(curve(turn), [0, 0, 0, 90], atol=1e-9)


def test_loops_are_drawn():
    result = room_result()
    plain, looped = (trajectory_picture(result.world_from_scan, None, "m", loops=x).axes[0] for x in ([], [(0, 4)]))
    assert len(looped.lines) == len(plain.lines) + 1


@pytest.mark.parametrize("standing", [False, True])
def test_short_and_standing_paths_can_be_drawn(standing, tmp_path):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.0 if standing else 3.0
    for truth in (None, poses):
        save_picture(trajectory_picture(poses, truth, "m"), tmp_path / "trajectory.png")
    assert (tmp_path / "trajectory.png").stat().st_size > 1000


def test_losses_have_a_panel_each_and_far_falls_a_logarithmic_axis():
    figure = losses_picture({"far": [100.0, 10.0, 1.0], "near": [3.0, 2.0, 1.0], "negative": [1.0, -50.0, -90.0]})
    panels = {axes.get_title(): axes for axes in figure.axes}
    assert list(panels) == ["far", "near", "negative"]
    assert [axes.get_yscale() for axes in panels.values()] == ["log", "linear", "linear"]
    np.testing.assert_allclose(curve(panels["negative"]), [1.0, -50.0, -90.0])


def test_a_curve_with_the_state_before_training_begins_at_epoch_0():
    figure = losses_picture({"total": [3.0, 2.0], "alignment": [4.0, 3.0, 2.0]})
    epochs = {axes.get_title(): axes.lines[0].get_xdata().tolist() for axes in figure.axes}
    assert epochs == {"total": [1, 2], "alignment": [0, 1, 2]}


@pytest.mark.parametrize(("length", "expected"), [(1.0, 1), (1.99, 1), (2.0, 2), (49.0, 20), (0.0071, 0.005)])
def test_scale_bars_are_round(length, expected):
    assert round_down(length) == pytest.approx(expected)
