"""Pairs that count as their points are alike: the weights, the equations, their gradients, and what they are for."""

import math

import pytest
import reference
import torch
from differences import gradcheck
from problems import as_pair, bumpy, motion, noisy_pair

from bbr_layer import (
    Adam,
    Annealed,
    Autograd,
    BBRLayer,
    BuddyFilter,
    GaussNewton,
    Implicit,
    Replay,
    RigidMotion,
    Stage,
    angular_error,
    estimate_normals,
)
from bbr_layer.kernels.likeness import likeness

INPUTS = ("P", "Q", "P_normals", "Q_normals")
SPACING = torch.tensor([0.4], dtype=torch.float64)


def _layer(steps, mode=None, alike=True, **sizes):
    return BBRLayer(
        Stage(BuddyFilter(reach=5.0, alike=alike), GaussNewton(steps), Annealed(1.0, 0.5), **sizes), backward=mode
    )


def _held(d):
    """A pair, a pose, and the index and mutual pairs there."""
    pair = as_pair(noisy_pair(d), "normals")._replace(spacing=SPACING)
    at = RigidMotion(*(x[None] for x in motion(d, 0.1, 0.05)))
    return pair, at, BuddyFilter().squares(pair).hold(at)


@pytest.mark.parametrize("d", [2, 3])
def test_the_weights_are_the_written_ones(d):
    pair, at, (index, mutual) = _held(d)
    moved = pair.moved_by(at)
    found = likeness(moved.Q - pair.P[:, index[0]], (pair.P_normals[:, index[0]], moved.Q_normals), SPACING)
    for j, i in enumerate(index[0].tolist()):
        wanted = reference.likeness(moved.Q[0, j] - pair.P[0, i], pair.P_normals[0, i], moved.Q_normals[0, j], 0.4)
        torch.testing.assert_close(found[0, j], wanted, rtol=1e-12, atol=0)
    assert mutual.sum() > 2 and found.max() / found.min() > 3


def test_the_equations_add_up_pairs_times_their_weight():
    pair, at, (index, mutual) = _held(3)
    temperature, moved = torch.tensor([0.3], dtype=torch.float64), pair.moved_by(at)
    weights = likeness(moved.Q - pair.P[:, index[0]], (pair.P_normals[:, index[0]], moved.Q_normals), SPACING)
    matrix, slope = torch.zeros(6, 6, dtype=torch.float64), torch.zeros(6, dtype=torch.float64)
    for j in torch.nonzero(mutual[0])[:, 0].tolist():
        alone = torch.zeros_like(mutual)
        alone[0, j] = True
        plain = BuddyFilter().squares(pair).equations(pair, at, temperature, (index, alone))
        matrix += weights[0, j] / mutual.sum() * plain.matrix[0]
        slope += weights[0, j] / mutual.sum() * plain.slope[0]
    found = BuddyFilter(alike=True).squares(pair).equations(pair, at, temperature, (index, mutual))
    torch.testing.assert_close(found.matrix[0], matrix, rtol=1e-10, atol=1e-13)
    torch.testing.assert_close(found.slope[0], slope, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("d", [2, 3])
def test_gradcheck(d):
    given, begun = noisy_pair(d), motion(d, 0.1, 0.05)
    leaves = tuple(given[name].requires_grad_() for name in INPUTS)

    def registered(*values):
        return _layer(3)(**dict(zip(INPUTS, values, strict=True)), start=begun).target_from_source.matrix

    assert all(g.abs().max() > 1e-6 for g in torch.autograd.grad(registered(*leaves).square().sum(), leaves))
    assert gradcheck(registered, leaves, eps=1e-6, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_replay_is_the_plain_unroll(backend, monkeypatch):
    monkeypatch.setenv("BBR_BACKEND", backend)
    given, found = noisy_pair(3), []
    leaves = [given[name].requires_grad_() for name in INPUTS]
    for mode in (Replay(), Autograd()):
        inputs = {name: given[name] for name in INPUTS}
        matrix = _layer(4, mode)(**inputs, start=motion(3, 0.1, 0.05)).target_from_source.matrix
        found.append((matrix.detach(), *torch.autograd.grad(matrix.square().sum(), leaves)))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10 * other.abs().max().item())


def test_implicit_is_replay_where_it_has_converged():
    P = bumpy(60, 3)
    Q = motion(3, 0.1, 0.02).inverse()(P + 0.01 * torch.randn_like(P))
    gradients = []
    for mode in (Replay(), Implicit(on_unconverged="raise")):
        leaf = torch.ones(60, dtype=torch.float64, requires_grad=True)
        stage = Stage(BuddyFilter(alike=True), GaussNewton(100), Annealed(1.0, 1.0))
        matrix = BBRLayer(stage, backward=mode)(P, Q, P_weights=leaf).target_from_source.matrix
        gradients.append(torch.autograd.grad(matrix.square().sum(), leaf)[0])
    assert gradients[0].norm() > 0
    assert (gradients[0] - gradients[1]).norm() <= 1e-6 * gradients[0].norm()


def test_two_samples_of_a_bent_surface_come_nearer():
    errors = {True: [], False: []}
    for seed in range(8):
        torch.manual_seed(seed)
        whole = bumpy(2000, 3)
        normals = estimate_normals(whole, 10)
        first, second = torch.randperm(2000)[:600].split(300)
        truth = motion(3, 0.05, 0.01)
        given = {"P": whole[first], "P_normals": normals[first], "Q": truth.inverse()(whole[second])}
        given["Q_normals"] = truth.inverse().rotate(normals[second])
        for alike, found in errors.items():
            answer = _layer(20, alike=alike)(**given).target_from_source
            found.append(angular_error(answer.rotation, truth.rotation).item())
    assert math.fsum(errors[True]) < 0.9 * math.fsum(errors[False])


def test_coincident_points_have_finite_derivatives():
    P = torch.zeros(1, 5, 3, dtype=torch.float64).requires_grad_()
    normals = torch.eye(3, dtype=torch.float64)[:1].expand(1, 5, 3)
    found = _layer(3)(P, P.detach().clone(), P_normals=normals, Q_normals=normals)
    (gradient,) = torch.autograd.grad(found.target_from_source.matrix.sum(), P)
    assert found.target_from_source.matrix.isfinite().all() and gradient.isfinite().all()


@pytest.mark.parametrize("inner", [None, Adam()])
def test_adam_is_refused(inner):
    with pytest.raises(ValueError, match=r"^BuddyFilter\(alike=True\) weighs pairs .*: give inner=GaussNewton\(\)"):
        Stage(BuddyFilter(alike=True), inner)


def test_a_stage_is_left_out_over_its_size():
    pair = as_pair(noisy_pair(3))  # 7 and 9 points
    wanted = [_layer(3, upto=upto).stages[0].wanted(pair) for upto in (None, 9, 8)]
    assert wanted == [True, True, False]
    assert "upto=9" in repr(_layer(3, upto=9))
    with pytest.raises(ValueError, match="^upto is 5; it must be a whole number of points over above=5, or None"):
        Stage(BuddyFilter(), above=5, upto=5)
