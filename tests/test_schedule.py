"""The three phases of the training."""

import pytest

from train.config import TrainingConfig
from train.schedule import Schedule


def test_the_phases_share_the_epochs():
    schedule = Schedule.of(TrainingConfig(epochs=20, warm_up=0.25, settle=0.1))
    assert schedule == (5, 13, 2)
    assert schedule.epochs == 20 and schedule.settles_at == 18


def test_poses_move_in_the_joint_phase_alone():
    schedule = Schedule(2, 4, 3)
    rates = [schedule.localisation_rate(epoch) for epoch in range(10)]
    assert rates[:3] == [0, 0, 1] and rates[6:] == [0, 0, 0, 0]
    assert 1 > rates[3] > rates[4] > rates[5] > 0


def test_the_occupancy_network_learns_all_the_time_and_ever_slower():
    schedule = Schedule(2, 4, 3)
    rates = [schedule.occupancy_rate(epoch) for epoch in range(10)]
    assert rates[0] == 1 and rates[8] > 0 and rates[9] == pytest.approx(0)
    assert sorted(rates, reverse=True) == rates


def test_progress_runs_from_0_to_1_over_the_joint_phase():
    schedule = Schedule(2, 4, 3)
    assert [schedule.progress(epoch) for epoch in range(9)] == pytest.approx([0, 0, 0, 1 / 3, 2 / 3, 1, 1, 1, 1])


@pytest.mark.parametrize("epochs", [1, 2, 3])
def test_a_short_training_still_moves_poses(epochs):
    assert Schedule.of(TrainingConfig(epochs=epochs)).joint >= 1


def test_shares_that_leave_nothing_are_all_occupancy():
    schedule = Schedule.of(TrainingConfig(epochs=4, warm_up=0.5, settle=0.5))
    assert schedule.joint == 0
    assert [schedule.localisation_rate(epoch) for epoch in range(4)] == [0] * 4
