"""A derivative by the motion, carried back to the coordinates that the optimiser works in."""

import math

import pytest
import torch
from differences import gradcheck

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.charts import EulerAngles, RotationVector, State
from bbr_layer.pair import Frame
from bbr_layer.rotations import rotation_dimensions, rotation_from_rotvec

CHARTS = [RotationVector(), EulerAngles()]


def _setting(d: int, chart: RotationVector | EulerAngles, angle: float = 0.7):
    generator = torch.Generator().manual_seed(d)
    random = [torch.randn(4, d, generator=generator, dtype=torch.float64) for _ in range(4)]
    k = rotation_dimensions(d)
    turn = random[0][:, :k] * angle
    frame = Frame(random[1], random[2], torch.tensor([0.5, 1.0, 2.0, 30.0], dtype=torch.float64))
    by_motion = RigidMotion(torch.randn(4, d, d, generator=generator, dtype=torch.float64), random[3])
    return State(turn if isinstance(chart, EulerAngles) else rotation_from_rotvec(turn), random[1]), frame, by_motion


def _by_autograd(chart, state: State, frame: Frame, by_motion: RigidMotion) -> torch.Tensor:
    batch, d = state.translation.shape
    tangent = torch.zeros(batch, rotation_dimensions(d) + d, dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(chart.motion(chart.moved(state, tangent), frame), tangent, by_motion)
    return found


@pytest.mark.parametrize("chart", CHARTS, ids=repr)
@pytest.mark.parametrize("d", [2, 3])
def test_the_slope_is_that_of_autograd(chart, d):
    state, frame, by_motion = _setting(d, chart)
    expected = _by_autograd(chart, state, frame, by_motion)
    torch.testing.assert_close(chart.slope(state, frame, by_motion), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("y", [math.pi / 2, -math.pi / 2], ids=["up", "down"])
def test_the_slope_at_gimbal_lock(y):
    state, frame, by_motion = _setting(3, EulerAngles())
    locked = State(torch.tensor([[0.3, y, -0.8]], dtype=torch.float64).expand(4, 3), state.translation)
    expected = _by_autograd(EulerAngles(), locked, frame, by_motion)
    torch.testing.assert_close(EulerAngles().slope(locked, frame, by_motion), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("chart", CHARTS, ids=repr)
@pytest.mark.parametrize("d", [2, 3])
def test_the_slope_is_differentiable(chart, d):
    state, frame, by_motion = _setting(d, chart)
    given = [x.clone().requires_grad_() for x in (*state, *frame, *by_motion)]

    def slope(*x):
        return chart.slope(State(*x[:2]), Frame(*x[2:5]), RigidMotion(*x[5:]))

    assert gradcheck(slope, given)
