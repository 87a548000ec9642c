"""The layer as its users meet it: known answers, batches, masks, places and units, modes, and wrong calls."""

import copy
import pickle
import sys

import numpy as np
import pytest
import torch
from problems import motion, noisy_pair

from bbr_layer import (
    Adam,
    Annealed,
    BBRLayer,
    Detached,
    RigidMotion,
    SoftBD,
    Stage,
    Status,
    Truncated,
    angular_error,
)
from bbr_layer.checks import check_normals, check_weights

NAMES = ["softBBS", "softBD", "N", "F"]


def _surface(n=120, seed=0):
    """Points of a bumpy closed surface, no symmetry, ``(n, 3)`` float64."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(n, 3, generator=generator, dtype=torch.float64)
    x = x / x.norm(dim=-1, keepdim=True)
    bumps = 1 + 0.3 * torch.sin(3 * x[:, :1]) + 0.2 * torch.cos(2 * x[:, 1:2] + 1) + 0.2 * x[:, 2:]
    return x * bumps * torch.tensor([1.0, 0.8, 0.6], dtype=torch.float64)


def _quick(name):
    return BBRLayer(name, inner=Adam(8, 0.05))


def _same(first, second, atol=1e-9):
    for a, b in zip(first.target_from_source, second.target_from_source, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=atol)


@pytest.mark.parametrize(("unit", "offset"), [(1.0, 0.0), (1000.0, 0.0), (0.001, 0.0), (1.0, 1e4)])
def test_default_registers_in_any_unit_and_place(unit, offset):
    P, truth = _surface(), motion(3, 0.5, 0.2)
    Q = truth.inverse()(P)
    result = BBRLayer()(P * unit + offset, Q * unit + offset)
    assert angular_error(result.target_from_source.rotation, truth.rotation) < 1e-3
    carried = result.target_from_source(Q * unit + offset)
    torch.testing.assert_close(carried, P * unit + offset, rtol=0, atol=2e-3 * unit)
    assert result.status == Status.CONVERGED and result.words == "converged"
    assert result.buddies == 120


def test_same_answer_in_metres_and_millimetres():
    given = noisy_pair(3, n=60, m=60)
    metres, millimetres = (BBRLayer()(given["P"] * s, given["Q"] * s).target_from_source for s in (1, 1000))
    assert angular_error(metres.rotation, millimetres.rotation) < 1e-8
    torch.testing.assert_close(millimetres.translation, 1000 * metres.translation, rtol=1e-7, atol=1e-6)


def test_float32_far_from_the_origin():
    P, truth = _surface().float(), motion(3, 0.3, 0.1).to(torch.float32)
    Q = truth.inverse()(P)
    far = BBRLayer()(P + 1000.0, Q + 1000.0)
    assert angular_error(far.target_from_source.rotation, truth.rotation.double()) < 2e-3


def test_two_dimensions():
    P, truth = _surface()[:, :2], motion(2, 0.4, 0.1)
    result = BBRLayer()(P, truth.inverse()(P))
    assert angular_error(result.target_from_source.rotation, truth.rotation) < 1e-3
    assert result.information.shape == (3, 3)


@pytest.mark.parametrize("name", NAMES)
def test_batch_equals_loop(name):
    given = noisy_pair(3, batch=6, n=20, m=25)
    given = {k: given[k].reshape(2, 3, *given[k].shape[1:]) for k in ("P", "Q", "P_normals", "Q_normals")}
    together = _quick(name)(**given)
    assert together.loss.shape == (2, 3)
    for i in range(2):
        for j in range(3):
            alone = _quick(name)(**{k: v[i, j] for k, v in given.items()})
            _same(alone, together._replace(target_from_source=together.target_from_source.item((i, j))))


@pytest.mark.parametrize("name", NAMES)
def test_mask_equals_removal_whatever_the_padding_holds(name):
    given = noisy_pair(3, n=20, m=25)
    P = torch.cat((given["P"], torch.full((1, 3, 3), torch.nan, dtype=torch.float64)), 1)
    Q = torch.cat((given["Q"], torch.full((1, 2, 3), 1e9, dtype=torch.float64)), 1)
    masked = _quick(name)(P, Q, P_mask=torch.arange(23)[None] < 20, Q_mask=torch.arange(27)[None] < 25)
    removed = _quick(name)(given["P"], given["Q"])
    _same(masked, removed)
    torch.testing.assert_close(masked.information, removed.information)
    assert torch.equal(masked.buddies, removed.buddies)


@pytest.mark.parametrize("name", NAMES)
def test_order_changes_nothing_and_common_motion_only_the_frame(name):
    given = noisy_pair(3, n=30, m=30)
    P, Q = given["P"][0], given["Q"][0]
    plain = _quick(name)(P, Q)
    _same(_quick(name)(P[torch.randperm(30)], Q[torch.randperm(30)]), plain)
    together = motion(3, 1.1, 5.0)
    carried = _quick(name)(together(P), together(Q))
    back = together.inverse() @ carried.target_from_source @ together
    _same(carried._replace(target_from_source=back), plain, atol=1e-7)


def test_one_start_serves_a_batch_and_is_where_it_begins():
    given = noisy_pair(3, batch=2)
    start = motion(3, 0.2, 0.1)
    slow = BBRLayer("softBD", inner=Adam(1, 1e-12))(given["P"], given["Q"], start=start)
    torch.testing.assert_close(slow.target_from_source.matrix, start.matrix.expand(2, 4, 4))


def test_modes_of_autograd_change_nothing():
    P, Q = (x.clone() for x in (noisy_pair(3)["P"], noisy_pair(3)["Q"]))
    layer = BBRLayer("softBD", inner=Adam(5))
    plain = layer(P.requires_grad_(), Q)
    with torch.no_grad():
        _same(layer(P, Q), plain)
    with torch.inference_mode():
        inferred = layer(P.detach().clone(), Q.clone())
        _same(inferred, plain)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        _same(layer(P, Q), plain)
    assert plain.loss.requires_grad and not inferred.loss.requires_grad
    assert not layer(P.detach(), Q).loss.requires_grad


def test_copies_pickles_and_says_what_it_is():
    layer = BBRLayer("softBD", backward=Truncated(3))
    given = noisy_pair(3)
    plain = layer(given["P"], given["Q"])
    for other in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer))):
        _same(other(given["P"], given["Q"]), plain)
    for shown in (layer, BBRLayer(), BBRLayer.fast(), BBRLayer.paper("N"), BBRLayer("F", backward=Truncated(3))):
        assert repr(eval(repr(shown), vars(sys.modules["bbr_layer"]).copy())) == repr(shown)
    assert "SoftBD(smoothing=0.2" in repr(layer) and "Truncated(last_steps=3)" in repr(layer)


@pytest.mark.parametrize("name", [*NAMES, None])
def test_singular_clouds_have_finite_answers_and_gradients(name):
    same = _surface(12)
    clouds = {
        "exact copy": (same, same.clone()),
        "duplicates": (same.repeat(2, 1), same.repeat(2, 1)),
        "all points coincide": (torch.ones(5, 3, dtype=torch.float64),) * 2,
        "far apart": (same, same + 1e4),
    }
    layer = BBRLayer() if name is None else _quick(name)
    for what, (P, Q) in clouds.items():
        P, Q = P.clone().requires_grad_(), Q.clone().requires_grad_()
        result = layer(P, Q)
        total = result.target_from_source.matrix.sum() + result.loss.sum()
        gradients = torch.autograd.grad(total, (P, Q))
        assert torch.isfinite(total), what
        assert all(torch.isfinite(g).all() for g in gradients), what


@pytest.mark.parametrize("name", NAMES)
def test_items_with_one_point_or_none_are_named_and_harm_nobody(name):
    given = noisy_pair(3, batch=3)
    P = given["P"].requires_grad_()
    mask = torch.ones(3, 7, dtype=torch.bool)
    mask[1], mask[2, 1:] = False, False
    result = _quick(name)(P, given["Q"], P_mask=mask)
    assert result.status[1] == Status.NO_BUDDIES
    assert result.status[2] == Status.DEGENERATE
    (gradient,) = torch.autograd.grad(result.target_from_source.matrix.sum(), P)
    assert torch.isfinite(gradient).all()
    assert torch.equal(gradient[1], torch.zeros(7, 3, dtype=torch.float64))
    _same(
        _quick(name)(P[0], given["Q"][0]),
        result._replace(target_from_source=result.target_from_source.item(0)),
    )


def test_a_plane_is_found_degenerate():
    sheet = torch.cartesian_prod(torch.arange(6.0), torch.arange(6.0)).double()
    plane = torch.cat((sheet, torch.zeros(36, 1, dtype=torch.float64)), 1)
    result = BBRLayer("F")(plane, plane.clone())
    assert result.status == Status.DEGENERATE and "do not trust" in result.words


P3, Q3 = torch.rand(8, 3), torch.rand(9, 3)
EYE = torch.eye(3)
WRONG = {
    "P has shape (3, 8); its last dimension must hold 2 or 3 coordinates: try P.mT": {"P": P3.mT},
    "Q has shape (3,); expected (*batch, points, 2 or 3)": {"Q": Q3[0]},
    "P has no points": {"P": P3[:0]},
    "Q has one point": {"Q": Q3[:1]},
    "Q holds 3 values that are NaN or infinite": {"Q": torch.cat((Q3, torch.full((1, 3), torch.nan)))},
    "Q has dtype torch.float64 and P torch.float32": {"Q": Q3.double()},
    "Q has dtype torch.float32 and P torch.int64: convert one, P.to(Q.dtype)": {"P": P3.long()},
    "Q is on meta and P on cpu": {"Q": Q3.to("meta")},
    "P is 3D and Q 2D": {"Q": Q3[:, :2]},
    "P has batch shape () and Q (1,)": {"Q": Q3[None]},
    "P has dtype torch.int64": {"P": P3.long(), "Q": Q3.long()},
    "P_normals holds 8 zero vectors: leave it out": {"P_normals": torch.zeros(8, 3)},
    "P_normals has shape (7, 3)": {"P_normals": P3[:7]},
    "P_normals has lengths from 0.0173 to 0.0173; normals have length 1: try": {"P_normals": torch.full((8, 3), 0.01)},
    "P_normals has dtype torch.bool and P torch.float32": {"P_normals": torch.ones(8, 3, dtype=torch.bool)},
    "P_weights has dtype torch.bool and P torch.float32": {"P_weights": torch.ones(8, dtype=torch.bool)},
    "P_features has shape (8, 0), no channels": {"P_features": torch.ones(8, 0), "Q_features": torch.ones(9, 0)},
    "Q_weights holds negative weights, as low as -1": {"Q_weights": -torch.ones(9)},
    "P_mask has dtype torch.float32": {"P_mask": torch.ones(8)},
    "Q_features is missing": {"P_features": torch.ones(8, 2)},
    "P is a list": {"P": [[0.0, 0.0, 0.0]] * 4},
    "P has batch shape (0,); that is no pair at all": {"P": P3.expand(0, 8, 3), "Q": Q3.expand(0, 9, 3)},
    "start.rotation is no rotation (R R^T is off the identity by 3": {"start": RigidMotion(2 * EYE, torch.zeros(3))},
    "start.rotation is no rotation": {"start": RigidMotion(-EYE, torch.zeros(3))},
    "start is a Tensor; expected a RigidMotion: try RigidMotion.from_matrix": {"start": torch.eye(4)},
    "start is a ndarray; expected a RigidMotion": {"start": np.eye(4)},
    "start holds (ndarray, ndarray); the layer takes tensors": {"start": RigidMotion(np.eye(3), np.zeros(3))},
    "start has rotation (2, 3, 3) and translation (3,)": {"start": RigidMotion(EYE.expand(2, 3, 3), torch.zeros(3))},
    "start moves 2D points and the clouds are 3D": {"start": RigidMotion.identity(2)},
}


@pytest.mark.parametrize("sentence", WRONG)
def test_wrong_calls_get_one_clear_sentence(sentence, as_a_user):
    with pytest.raises(ValueError) as caught:
        BBRLayer()(**{"P": P3, "Q": Q3, **WRONG[sentence]})
    assert str(caught.value).startswith(sentence)
    assert "\n" not in str(caught.value)


def test_wrong_settings_are_refused_where_they_are_given(as_a_user):
    with pytest.raises(ValueError, match="there is no loss 'softBBQ'"):
        BBRLayer("softBBQ")
    with pytest.raises(ValueError, match="inner and temperature belong to one stage"):
        BBRLayer(inner=Adam(3))
    with pytest.raises(ValueError, match="last_steps is 0"):
        Truncated(0)
    with pytest.raises(ValueError, match="start is -2"):
        Annealed(-2.0)
    with pytest.raises(ValueError, match=r"loss is 'F'; it must be one of the four losses: try SoftBBS\(\)"):
        Stage("F")
    with pytest.raises(ValueError, match=r"temperature is 0.5; it must be Annealed"):
        Stage(SoftBD(), temperature=0.5)
    with pytest.raises(ValueError, match=r"backward is 'replay'; it must be one of the modes, as an object: try"):
        BBRLayer(backward="replay")


def test_detached_layer_still_moves_its_argument_differentiably():
    given = noisy_pair(3)
    Q = given["Q"].requires_grad_()
    result = BBRLayer(Stage(SoftBD(), Adam(3)), backward=Detached())(given["P"], Q)
    moved = result.target_from_source(Q)
    (gradient,) = torch.autograd.grad(moved.sum(), Q)
    expected = result.target_from_source.rotation[0].sum(0).expand(9, 3)
    torch.testing.assert_close(gradient[0], expected.detach())


@pytest.mark.parametrize("layer", [BBRLayer(), BBRLayer.robust(), BBRLayer("N")], ids=["default", "robust", "N"])
def test_without_any_weight_there_are_no_buddies(layer):
    given = noisy_pair(3)
    found = layer(given["P"], given["Q"], P_weights=torch.zeros(given["P"].shape[:-1]).double())
    assert found.status == Status.NO_BUDDIES and found.confidence == 0


def test_padding_may_hold_any_weights_and_normals():
    points, mask = torch.rand(3, 3), torch.tensor([True, True, False])
    check_weights("P_weights", torch.tensor([1.0, 0.0, -1.0]), points, mask)
    check_normals("P_normals", torch.eye(3) * mask[:, None], points, mask)


def test_a_source_in_one_place_has_radius_1():
    P = torch.rand(30, 3)
    assert BBRLayer("F")(P, P[:1].expand(30, 3)).radius == 1
