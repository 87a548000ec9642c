"""F of a finite reach: its equation, its derivatives in every path, and what it is for."""

import math

import pytest
import reference
import torch
from differences import gradcheck
from problems import as_pair, bumpy, motion, noisy_pair

from bbr_layer import Adam, Annealed, Autograd, BBRLayer, BuddyFilter, GaussNewton, Replay, Stage
from bbr_layer.temperature import Unrounded

REACH = 1.3
INPUTS = ("P", "Q", "P_normals", "Q_normals", "P_weights", "Q_weights")


def _layer(inner, mode=None):
    return BBRLayer(Stage(BuddyFilter(reach=REACH), inner, Annealed(1.0, 0.5)), backward=mode or Replay())


def _outputs(result):
    return torch.cat((result.target_from_source.matrix.flatten(), result.loss.flatten()))


@pytest.mark.parametrize("temperature", [0.3, 0.01])
@pytest.mark.parametrize("d", [2, 3])
def test_the_loss_is_its_equation(d, temperature):
    given = noisy_pair(d)
    pair = as_pair(given, "normals", "weights")
    fields = [given[name][0] for name in ("P", "Q", "P_normals", "Q_normals")]
    planes = (reference.point_to_plane_distances(*fields).square() + temperature**2).sqrt()
    flat = reference.flattened(planes, REACH * temperature)
    weights = given["P_weights"][0], given["Q_weights"][0]
    wanted = reference.buddy_filter(reference.distances(*fields[:2]), flat, weights)
    value = BuddyFilter(reach=REACH)(pair, torch.tensor([temperature], dtype=torch.float64))
    torch.testing.assert_close(value[0], wanted, rtol=1e-12, atol=1e-12)
    assert value < REACH * temperature


def test_an_infinite_reach_is_the_printed_equation():
    pair, temperature = as_pair(noisy_pair(3), "normals"), torch.tensor([0.3], dtype=torch.float64)
    assert torch.equal(BuddyFilter(reach=math.inf)(pair, temperature), BuddyFilter()(pair, temperature))
    torch.testing.assert_close(
        BuddyFilter(reach=1e12)(pair, temperature), BuddyFilter()(pair, temperature), rtol=1e-9, atol=0
    )


@pytest.mark.parametrize("inner", [Adam(4, 0.05), GaussNewton(4)], ids=["Adam", "GaussNewton"])
@pytest.mark.parametrize("d", [2, 3])
def test_gradcheck(d, inner):
    given, begun = noisy_pair(d), motion(d, 0.1, 0.05)
    leaves = tuple(given[name].requires_grad_() for name in INPUTS)

    def registered(*values):
        return _outputs(_layer(inner)(**dict(zip(INPUTS, values, strict=True)), start=begun))

    assert all(g.abs().max() > 1e-6 for g in torch.autograd.grad(registered(*leaves).square().sum(), leaves))
    assert gradcheck(registered, leaves, eps=1e-6, atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("inner", [Adam(6, 0.05), GaussNewton(6)], ids=["Adam", "GaussNewton"])
@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_replay_is_the_plain_unroll(inner, backend, monkeypatch):
    monkeypatch.setenv("BBR_BACKEND", backend)
    given, found = noisy_pair(3), []
    leaves = [given[name].requires_grad_() for name in INPUTS]
    for mode in (Replay(), Autograd()):
        value = _outputs(_layer(inner, mode)(**{name: given[name] for name in INPUTS}, start=motion(3, 0.1, 0.05)))
        found.append((value.detach(), *torch.autograd.grad(value.square().sum(), leaves)))
    for one, other in zip(*found, strict=True):
        assert other.abs().max() > 1e-6
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10 * other.abs().max().item())


def test_a_second_surface_hardly_pulls():
    torch.manual_seed(0)
    P = bumpy(300, 3)
    Q = motion(3, 0.02, 0.01).inverse()(P)
    strange = Q[:60] + 0.1 * torch.nn.functional.normalize(Q[:60], dim=-1)
    errors = []
    for reach in (math.inf, 50.0):
        layer = BBRLayer(Stage(BuddyFilter(reach=reach), Adam(200, 0.005), Annealed(0.3, 0.03)))
        found = layer(P, torch.cat((Q[60:], strange))).target_from_source
        errors.append((found(Q) - P).norm(dim=-1).mean().item())
    assert errors[1] < 0.5 * errors[0]


def test_coincident_points_have_finite_derivatives():
    P = torch.zeros(1, 5, 3, dtype=torch.float64).requires_grad_()
    normals = torch.eye(3, dtype=torch.float64)[:1].expand(1, 5, 3)
    found = _layer(Adam(3, 0.05))(P, P.detach().clone(), P_normals=normals, Q_normals=normals)
    (gradient,) = torch.autograd.grad(found.target_from_source.matrix.sum(), P)
    assert found.target_from_source.matrix.isfinite().all() and gradient.isfinite().all()


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ValueError, match="^reach is 0; it is a length in temperatures and positive: try 50"):
        BuddyFilter(reach=0)
    with pytest.raises(ValueError, match=r"^temperature is Unrounded\(\), and the reach of .* a multiple of it"):
        Stage(BuddyFilter(reach=5.0), temperature=Unrounded())
    assert repr(BuddyFilter(reach=5.0)) == "BuddyFilter(reach=5)" and repr(BuddyFilter()) == "BuddyFilter()"
