"""The four losses against the paper's equations as loops, and what must not change them."""

import pytest
import reference
import torch
from problems import as_pair, motion, noisy_pair

from bbr_layer import BuddyFilter, CloudPair, SoftBBS, SoftBD, SoftBDNormals, hard_buddies, soft_buddies

ALPHA, EPS = 0.3, 1e-10
LOSSES = {"softBBS": SoftBBS, "softBD": SoftBD, "N": SoftBDNormals, "F": BuddyFilter}


def _literal(name, given, weighted=False):
    P, Q = given["P"][0], given["Q"][0]
    weights = (given["P_weights"][0], given["Q_weights"][0]) if weighted else None
    D = reference.distances(P, Q)
    planes = reference.point_to_plane_distances(P, Q, given["P_normals"][0], given["Q_normals"][0])
    if name == "softBBS":
        return reference.soft_bbs(D, ALPHA, EPS, weights)
    if name == "softBD":
        return reference.soft_bd(D, ALPHA, EPS, weights)
    if name == "N":
        return reference.soft_bd(planes, ALPHA, EPS, weights)
    return reference.buddy_filter(D, planes, weights)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", LOSSES)
def test_loss_is_its_equation(name, d, weighted):
    given = noisy_pair(d)
    pair = as_pair(given, "normals", *(["weights"] if weighted else []))
    temperature = torch.tensor([0.0 if name == "F" else ALPHA], dtype=torch.float64)
    value = LOSSES[name]()(pair, temperature)
    torch.testing.assert_close(value[0], _literal(name, given, weighted), rtol=1e-12, atol=1e-12)


def test_buddies_are_their_equations():
    D = torch.rand(2, 6, 8, dtype=torch.float64)
    for item in range(2):
        assert torch.equal(hard_buddies(D)[item].double(), reference.hard_buddies(D[item]))
        soft = soft_buddies(D, torch.full((2,), 0.1, dtype=torch.float64), EPS)[item]
        torch.testing.assert_close(soft, reference.soft_buddies(D[item], 0.1, EPS), rtol=1e-12, atol=1e-15)
    assert reference.bbs(D[0]) == -hard_buddies(D[0]).sum()


def test_soft_buddies_become_hard_ones_when_cold():
    D = torch.rand(5, 5, dtype=torch.float64)
    cold = soft_buddies(D, torch.tensor(1e-3, dtype=torch.float64), outlier=0.0)
    torch.testing.assert_close(cold.round(), hard_buddies(D).double())


def test_buddies_take_a_number_for_the_temperature_and_a_boolean_mask(as_a_user):
    D = torch.rand(4, 5, dtype=torch.float64)
    torch.testing.assert_close(soft_buddies(D, 0.3), soft_buddies(D, torch.tensor(0.3)))
    for wrong in (lambda: hard_buddies(D, D), lambda: soft_buddies(D, 0.3, mask=D)):
        with pytest.raises(ValueError, match=r"^mask has dtype torch.float64; it is boolean.*try hard_buddies"):
            wrong()


def test_far_points_have_no_buddies_and_no_gradient_trouble():
    D = torch.full((3, 4), 1e4, dtype=torch.float64, requires_grad=True)
    B = soft_buddies(D, torch.tensor(1e-2, dtype=torch.float64))
    assert B.max() == 0
    assert torch.isfinite(torch.autograd.grad(B.sum(), D)[0]).all()


@pytest.mark.parametrize("name", LOSSES)
def test_mask_equals_removal(name):
    given = noisy_pair(3)
    padded = {k: torch.cat((v, torch.full_like(v[:, :2], 50.0)), dim=1) for k, v in given.items()}
    temperature = torch.tensor([ALPHA], dtype=torch.float64)
    pair = as_pair(padded, "normals", "weights")
    rows, columns = torch.arange(9) < 7, torch.arange(11) < 9
    masked = LOSSES[name]()(pair._replace(P_mask=rows[None], Q_mask=columns[None]), temperature)
    torch.testing.assert_close(masked, LOSSES[name]()(as_pair(given, "normals", "weights"), temperature))


@pytest.mark.parametrize("name", LOSSES)
def test_common_motion_and_order_change_nothing(name):
    given, temperature = noisy_pair(3), torch.tensor([ALPHA], dtype=torch.float64)
    pair, together = as_pair(given, "normals"), motion(3, 1.0, 3.0)
    value = LOSSES[name]()(pair, temperature)
    carried = CloudPair(
        together(pair.P), together(pair.Q), together.rotate(pair.P_normals), together.rotate(pair.Q_normals),
        spacing=pair.spacing,
    )  # fmt: skip
    torch.testing.assert_close(LOSSES[name]()(carried, temperature), value)
    order = torch.randperm(9)
    shuffled = pair._replace(Q=pair.Q[:, order], Q_normals=pair.Q_normals[:, order])
    torch.testing.assert_close(LOSSES[name]()(shuffled, temperature), value)


@pytest.mark.parametrize("match", ["features", "both"])
def test_soft_bd_matches_on_features(match):
    given = noisy_pair(3)
    pair = as_pair(given, "features")
    value = SoftBD(match=match, feature_weight=0.7)(pair, torch.tensor([ALPHA], dtype=torch.float64))
    P, Q = 0.7 * given["P_features"][0], 0.7 * given["Q_features"][0]
    if match == "both":
        P, Q = torch.cat((given["P"][0], P), -1), torch.cat((given["Q"][0], Q), -1)
    D = reference.distances(given["P"][0], given["Q"][0])
    literal = reference.soft_bd(D, ALPHA, EPS, matching=reference.distances(P, Q))
    torch.testing.assert_close(value[0], literal, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", LOSSES)
def test_coincident_clouds_have_finite_gradients(name):
    given = noisy_pair(3)
    P = given["P"].requires_grad_()
    pair = CloudPair(P, P.detach().clone(), given["P_normals"], given["P_normals"].clone())
    loss = LOSSES[name]()(pair, torch.tensor([0.0 if name == "F" else ALPHA], dtype=torch.float64))
    (gradient,) = torch.autograd.grad(loss.sum(), P)
    assert torch.isfinite(loss).all()
    assert torch.isfinite(gradient).all()


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="match='features' leaves softBBS without a pose"):
        SoftBBS(match="features")
    with pytest.raises(ValueError, match="clip is 0.0; it must be positive, in standard deviations"):
        SoftBDNormals(clip=0.0)
    with pytest.raises(ValueError, match="smoothing is -1"):
        BuddyFilter(smoothing=-1.0)
    with pytest.raises(ValueError, match="P_features or Q_features is missing"):
        SoftBD(match="both")(as_pair(noisy_pair(3)), torch.tensor([ALPHA], dtype=torch.float64))
