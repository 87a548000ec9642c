"""Whether a registration had settled: its pose a tenth of the steps before the end, whoever took them."""

import pytest
import torch
from problems import bumpy, motion

from bbr_layer import Adam, Annealed, Autograd, BBRLayer, Detached, GaussNewton, Replay, Status, Truncated
from bbr_layer.inner.schedules import Constant
from bbr_layer.inner.unroll import value

STEPS, TAIL = 10, 9


def _layer(name, steps, backward):
    name, *solver = name.split(", ")
    inner = GaussNewton(steps, damping=3.0) if solver else Adam(steps, 0.01, schedule=Constant())
    return BBRLayer(name, inner=inner, temperature=Annealed(1.0, 1.0), backward=backward)


def _pair():
    torch.manual_seed(0)
    P = bumpy(60, 3).double()
    return P, motion(3, 0.3).inverse()(P[None])[0] + 0.01 * torch.randn_like(P)


@pytest.mark.parametrize(
    "backward", [Replay(), Truncated(1), Truncated(2), Truncated(5), Autograd(), Detached()], ids=repr
)
@pytest.mark.parametrize("name", ["softBBS", "F", "F, Gauss-Newton"])
def test_what_is_compared_is_the_pose_a_tenth_of_the_steps_before_the_end(name, backward, monkeypatch):
    P, Q = _pair()
    Q.requires_grad_(not isinstance(backward, Detached))
    wanted = _layer(name, TAIL, Detached())(P, Q).target_from_source
    seen = []
    monkeypatch.setattr(
        "bbr_layer.stage.moved_little", lambda first, second, pair: seen.append(first) or torch.ones(1).bool()
    )
    found = _layer(name, STEPS, backward)(P, Q).target_from_source
    (earlier,) = seen
    assert not earlier.rotation.requires_grad
    torch.testing.assert_close(earlier.rotation[0], wanted.rotation)
    assert not torch.allclose(found.rotation, wanted.rotation, atol=1e-6)


def test_a_pose_that_still_moves_is_told_from_one_that_stays():
    P, Q = _pair()
    assert _layer("softBBS", 10, Detached())(P, Q).status == Status.ITERATION_LIMIT
    assert BBRLayer("softBBS", inner=Adam(60, 0.05))(P, Q).status == Status.CONVERGED
    assert BBRLayer("F", inner=GaussNewton(1))(P, Q).status == Status.ITERATION_LIMIT


def test_the_loss_is_that_of_the_last_stage_and_earlier_ones_are_not_asked(monkeypatch):
    P, Q = _pair()
    asked = []
    monkeypatch.setattr("bbr_layer.stage.value", lambda *given: asked.append(value(*given)) or asked[-1])
    found = BBRLayer(backward=Detached())(P, Q)
    assert len(asked) == 1 and found.loss == asked[0][0]
