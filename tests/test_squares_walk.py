"""Gauss-Newton on F without tensors between its steps, against the same steps in torch."""

import numpy as np
import pytest
import torch
from problems import motion, noisy_pair

from bbr_layer import Annealed, BBRLayer, BuddyFilter, GaussNewton, Stage
from bbr_layer.inner.unroll import _gauss_newton_step

pytest.importorskip("numba", reason="the steps in numpy need numba")
from bbr_layer.inner.squares_walk import _step  # noqa: E402

HOT = (1.0, 0.5)


@pytest.mark.parametrize("damping", [1e-6, 0.3])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("loss", [BuddyFilter(), BuddyFilter(reach=1.3), BuddyFilter(alike=True)], ids=str)
def test_steps_in_numpy_are_those_in_torch(loss, d, masked, damping, monkeypatch):
    given = {k: v for k, v in noisy_pair(d, batch=3, n=30, m=34).items() if "features" not in k}
    if masked:
        given["P_mask"], given["Q_mask"] = torch.rand(3, 30) > 0.2, torch.rand(3, 34) > 0.2
    stage = Stage(loss, GaussNewton(6, damping=damping), Annealed(*HOT))
    found, calls = [], []
    for backend in ("numba", "torch"):
        monkeypatch.setenv("BBR_BACKEND", backend)
        monkeypatch.setattr("bbr_layer.inner.unroll._gauss_newton_step", _counting(calls, backend))
        leaves = {k: v.clone().requires_grad_() for k, v in given.items() if v.dtype == torch.float64}
        result = BBRLayer(stage)(**{**given, **leaves}, start=motion(d, 0.4, 0.3))
        total = result.target_from_source.matrix.square().sum() + result.loss.sum()
        gradients = torch.autograd.grad(total, list(leaves.values()), allow_unused=True)
        kept = [result.target_from_source.matrix, result.loss, result.gradient_norm, result.temperature]
        found.append([*kept, *(torch.zeros(1) if g is None else g for g in gradients)])
    assert calls == ["torch"] * 6
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-11)


def _counting(calls, backend):
    def step(problem, inner, at):
        calls.append(backend)
        return _gauss_newton_step(problem, inner, at)

    return step


def test_equations_that_nothing_holds_are_no_error():
    assert not np.isfinite(_step(np.diag([1.0, 0.0]), np.ones(2), 0.0)).any()
    assert (_step(np.zeros((2, 2)), np.zeros(2), 1e-6) == 0).all()
