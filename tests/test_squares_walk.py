"""Gauss-Newton on F without tensors between its steps, and its compiled adjoint, against the same steps in torch."""

import numpy as np
import pytest
import torch
from differences import gradcheck
from problems import motion, noisy_pair

from bbr_layer import Annealed, BBRLayer, BuddyFilter, CloudPair, GaussNewton, RigidMotion, Stage
from bbr_layer.inner.charts import RotationVector, State
from bbr_layer.inner.gauss_newton import DAMPING, LONGEST_STEP, shortened
from bbr_layer.inner.squares_step import BoundSquares
from bbr_layer.inner.unroll import _gauss_newton_step

pytest.importorskip("numba", reason="the steps in numpy need numba")
from bbr_layer.inner.squares_course import step_of  # noqa: E402
from bbr_layer.inner.squares_walk import Steps, walk  # noqa: E402

HOT = (1.0, 0.5)
LOSSES = [BuddyFilter(), BuddyFilter(reach=1.3), BuddyFilter(alike=True), BuddyFilter(reach=1.3, alike=True)]


@pytest.mark.parametrize("damping", [1e-6, 0.3])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("loss", LOSSES[:3], ids=str)
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
    assert not np.isfinite(step_of(np.diag([1.0, 0.0]), np.ones(2), 0.0)).any()
    assert (step_of(np.zeros((2, 2)), np.zeros(2), 1e-6) == 0).all()


def _problem(case, d, n=30, m=34):
    """A batch of three pairs, with float64 fields that all have a gradient, and where they begin."""
    given = {k: v for k, v in noisy_pair(d, batch=3, n=n, m=m).items() if "features" not in k}
    at = motion(d, 0.3, 0.2)
    if case == "unweighted":
        given = {k: v for k, v in given.items() if "weights" not in k}
    elif case == "padded":
        given["P_mask"], given["Q_mask"] = torch.rand(3, n) > 0.2, torch.rand(3, m) > 0.2
    elif case == "long steps":
        given["P"], given["Q"] = 10 * given["P"], 10 * given["Q"]
    elif case == "one pair, no pair":
        given["P_mask"], given["Q_mask"] = torch.arange(n) < torch.tensor([[1], [0], [n]]), torch.rand(3, m) > 0.2
    elif case == "no weight":
        given["Q_weights"][1] = 0.0
    elif case == "exact copies":
        at = motion(d, 0.0, 0.0)
        given |= {"Q": given["P"].clone(), "Q_normals": given["P_normals"].clone(), "Q_weights": given["P_weights"]}
    elif case == "some on each other's planes":
        at = motion(d, 0.0, 0.0)
        for name in ("", "_normals"):
            given[f"Q{name}"][:, :9] = given[f"P{name}"][:, :9]
    pair = CloudPair(**given, spacing=torch.tensor([0.5, 0.4, 0.6], dtype=torch.float64))
    return pair, (at.rotation.expand(3, d, d).clone(), at.translation.expand(3, d).clone())


def _compiled(squares, pair, start, temperatures, damping):
    return walk(Steps(BoundSquares(squares, pair, stored=False), damping, 0), State(*start), temperatures)[:2]


def _in_torch(squares, pair, start, temperatures, damping):
    bound, state, d = BoundSquares(squares, pair, stored=True), State(*start), pair.P.shape[-1]
    lengths = []
    for temperature in temperatures:
        step, _ = bound.step(RigidMotion(*state), temperature, damping)
        lengths.append(step[:, -d:].detach().norm(dim=-1))
        state = RotationVector().moved(state, shortened(step, d))
    return *state, torch.stack(lengths)


def _leaves(pair, start, temperatures):
    """Everything that has a gradient, and what puts it back."""
    names = [name for name, x in pair._asdict().items() if x is not None and x.is_floating_point()]
    leaves = [x.detach().clone().requires_grad_() for x in (*start, temperatures, *(getattr(pair, k) for k in names))]
    return leaves, lambda x: (pair._replace(**dict(zip(names, x[3:], strict=True))), x[:2], x[2])


def _differences(squares, given, damping):
    """Of poses and gradients by everything, compiled and in torch: how far apart, how long; then how far torch went."""
    d, (leaves, put_back) = given[0].P.shape[-1], _leaves(*given)
    by_rotation, by_translation = torch.randn(3, d, d, dtype=torch.float64), torch.randn(3, d, dtype=torch.float64)
    answers = []
    for take in (_compiled, _in_torch):
        rotation, translation, *lengths = take(squares, *put_back(leaves), damping)
        total = (rotation * by_rotation).sum() + (translation * by_translation).sum()
        gradients = torch.autograd.grad(total, leaves, materialize_grads=True)
        answers.append([rotation.detach(), translation.detach(), *gradients])
    return [((a - b).norm(), b.norm()) for a, b in zip(*answers, strict=True)], lengths[0]


CASES = ["plain", "unweighted", "padded", "long steps", "one pair, no pair", "no weight", "exact copies"]


@pytest.mark.parametrize("damping", [DAMPING, 0.3])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_the_compiled_adjoint_is_that_of_torch(loss, d, case, damping):
    pair, start = _problem(case, d)
    temperatures = torch.tensor([[0.3, 0.4, 0.2], [0.15, 0.2, 0.1]], dtype=torch.float64)
    differences, lengths = _differences(loss.squares(pair), (pair, start, temperatures), damping)
    assert (lengths > LONGEST_STEP).any() == (case == "long steps" and damping == DAMPING)
    regular = damping > DAMPING or case != "one pair, no pair"  # else only the damping holds all but one direction
    tolerance, rounding = (1e-12, 1e-14) if regular else (1e-7, 1e-8)
    for apart, length in differences:
        assert apart <= tolerance * length + rounding


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("loss", [BuddyFilter(), BuddyFilter(alike=True)], ids=str)
def test_pairs_on_each_others_planes_do_not_pull_where_nothing_is_rounded(loss, d):
    pair, start = _problem("some on each other's planes", d)
    assert loss.squares(pair).search(RigidMotion(*start))[1][:, :9].sum() > 9
    given = pair, start, torch.zeros(2, 3, dtype=torch.float64)
    for apart, length in _differences(loss.squares(pair), given, DAMPING)[0]:
        assert apart <= 1e-10 * length + 1e-14


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("loss", LOSSES, ids=str)
def test_gradcheck_by_everything(loss, d):
    pair, start = _problem("plain", d, n=7, m=9)
    squares, temperatures = loss.squares(pair), torch.full((2, 3), 0.3, dtype=torch.float64)
    leaves, put_back = _leaves(pair, start, temperatures)
    assert gradcheck(
        lambda *x: _compiled(squares, *put_back(x), DAMPING), leaves, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True
    )


@pytest.mark.parametrize("d", [2, 3])
def test_gradients_by_start_temperature_and_through_estimated_normals(d, monkeypatch):
    given = {k: v for k, v in noisy_pair(d, n=30, m=34).items() if k in ("P", "Q")}
    stage, found = Stage(BuddyFilter(reach=1.3, alike=True), GaussNewton(3)), []
    for backend in ("numba", "torch"):
        monkeypatch.setenv("BBR_BACKEND", backend)
        leaves = [x.clone().requires_grad_() for x in (*given.values(), *(x[None] for x in motion(d, 0.4, 0.3)))]
        numbers = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in HOT]
        stage.temperature = Annealed(*numbers)
        matrix = BBRLayer(stage)(*leaves[:2], start=RigidMotion(*leaves[2:])).target_from_source.matrix
        found.append(torch.autograd.grad(matrix.square().sum(), (*leaves, *numbers)))
    for compiled, wanted in zip(*found, strict=True):
        assert wanted.any() and (compiled - wanted).norm() <= 1e-11 * wanted.norm()
