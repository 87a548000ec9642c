"""What must not change how far an answer is trusted: points given twice, padding; and that a handful says little."""

import math

import pytest
import torch
import trimesh
from problems import bumpy

from bbr_layer import Adam, BBRLayer, CloudPair, GaussNewton, RigidMotion, Stage, Status
from bbr_layer.confidence import COEFFICIENTS, confidence, judged_clouds, statistics
from bbr_layer.ellipsoid import half_turned, turned_within
from bbr_layer.losses import BuddyFilter, SoftBD
from bbr_layer.matches import matched
from bbr_layer.preparation import prepared
from benchmarks.volumes import VOLUMES

STILL = RigidMotion.identity(3)


def _samples(n):
    return bumpy(n, 3), bumpy(n, 3)


def _again(points, share):
    """The points, and so many of them once more."""
    return torch.cat((points, points[: int(share * len(points))]))


@pytest.mark.parametrize("share", [1 / 3, 1.0])
def test_points_given_twice_are_no_evidence_against_an_answer(share):
    P, Q = _samples(300)
    layer = BBRLayer("F", inner=Adam(1, 1e-9))
    once = layer(P, Q, start=STILL)
    for twice in ((_again(P, share), _again(Q, share)), (P, _again(Q, share))):
        found = layer(*twice, start=STILL)
        assert found.confidence == pytest.approx(float(once.confidence), abs=0.02)
    assert once.confidence > 0.9


def test_padding_is_no_duplicate():
    P, Q = _samples(120)
    mask = torch.arange(150) < 120
    padded = [torch.cat((x, x.new_zeros(30, 3))) for x in (P, Q)]
    layer = BBRLayer("F", inner=Adam(1, 1e-9))
    found = layer(*padded, P_mask=mask, Q_mask=mask, start=STILL)
    torch.testing.assert_close(found.confidence, layer(P, Q, start=STILL).confidence)


@pytest.mark.parametrize("n", [5, 20, 60])
def test_few_points_are_believed_little_whatever_they_say(n):
    P, Q = torch.rand(n, 3), torch.rand(300, 3)
    assert 0 <= BBRLayer.fast()(P, Q).confidence <= n / 100


@pytest.mark.parametrize("volume", VOLUMES)
def test_volumes_with_nothing_in_common_are_not_believed(volume):
    for seed in range(3):
        torch.manual_seed(seed)
        assert BBRLayer()(VOLUMES[volume](800), VOLUMES[volume](800)).confidence < 0.5


@pytest.mark.parametrize("volume", VOLUMES)
def test_a_volume_and_its_noisy_copy_are_believed(volume):
    P = VOLUMES[volume](800)
    assert BBRLayer()(P, P + 0.01 * torch.randn_like(P)).confidence > 0.9


def _street(n):
    """As a sensor in its middle sees it: the farther the thinner, ground and two walls."""
    distance, angle, height = 40 * torch.rand(n) ** 2, 2 * math.pi * torch.rand(n), 3 * torch.rand(n)
    x, y = distance * angle.cos(), (distance * angle.sin()).clamp(-8, 8)
    return torch.stack((x, y, torch.where(y.abs() == 8, height, 0.05 * x.sin())), -1)


SURFACES = {"bumpy": lambda n: bumpy(n, 3), "street": _street}


def _where_they_lie(P, Q):
    """What confidence is asked about clouds that need no motion: both, that motion and who is whose nearest."""
    frame, pair = prepared(CloudPair(P, Q, *[None] * 9), needs_normals=True, scaled=True)
    seen, motion = judged_clouds(pair), frame.enter(RigidMotion.identity(3, (len(P),)))
    return seen, motion, matched(seen, motion)


@pytest.mark.parametrize("surface", SURFACES)
def test_the_look_elsewhere_takes_nothing_from_a_surface(surface):
    seen, motion, found = _where_they_lie(*(SURFACES[surface](500)[None] for _ in range(2)))
    shares = torch.cat((torch.ones(1, 1), statistics(seen, found)), -1).double()
    plain = torch.sigmoid(shares @ torch.tensor(COEFFICIENTS).double())
    torch.testing.assert_close(confidence(seen, motion, found), plain)
    assert plain > 0.9


def test_a_surface_is_believed_the_same_beside_a_volume():
    P, Q = (torch.stack((_street(500), VOLUMES["rod, 6 x 1 x 1"](500))) for _ in range(2))
    street, rod = confidence(*_where_they_lie(P, Q))
    torch.testing.assert_close(street, confidence(*_where_they_lie(P[:1], Q[:1]))[0])
    assert street > 0.9 and rod < 0.5


BOXES = {"room": (6.0, 4.0, 2.5), "beam": (6.0, 1.2, 1.0), "plate": (6.0, 5.0, 0.5)}


@pytest.mark.parametrize("box", BOXES)
def test_a_box_that_fits_itself_half_turned_is_believed(box):
    mesh = trimesh.creation.box(BOXES[box])
    P, Q = (torch.tensor(trimesh.sample.sample_surface(mesh, 1000, seed=k)[0]) for k in (1, 2))
    assert BBRLayer()(P, Q).confidence > 0.9


def _flat_cloud(d):
    """Points of a plane or a line among others, some of them padding, and normals that are those of the plane."""
    points = torch.randn(50, d).double() * torch.arange(1.0, d + 1) + 5
    normal = torch.nn.functional.normalize(torch.randn(d).double(), dim=0)
    points[:20] -= (points[:20] @ normal - 3)[:, None] * normal
    pair = CloudPair(points[None], points[None], *[normal.expand(1, 50, d)] * 2)
    return pair._replace(Q_mask=torch.arange(50)[None] < 40)


@pytest.mark.parametrize("d", [2, 3])
def test_a_turn_within_the_ellipsoid_keeps_it_and_normals_with_their_surface(d):
    pair = _flat_cloud(d)
    turned = turned_within(pair, 40.0)
    before, after = pair.Q[0, :40], turned.Q[0, :40]
    assert (before - after).norm(dim=1).mean() > 1
    torch.testing.assert_close(after.mean(0), before.mean(0))
    torch.testing.assert_close(after.T.cov(), before.T.cov())
    heights = (turned.Q_normals * turned.Q)[0, :20].sum(-1)
    torch.testing.assert_close(heights, heights[:1].expand(20))
    torch.testing.assert_close(turned.Q_normals.norm(dim=-1), torch.ones(1, 50).double())


@pytest.mark.parametrize("d", [2, 3])
def test_half_a_turn_is_that_within_the_ellipsoid(d):
    pair, angles = _flat_cloud(d), torch.randn(1, 2 * d - 3).double()
    motion = RigidMotion.from_rotvec(angles, torch.randn(1, d).double())
    torch.testing.assert_close(half_turned(pair, motion)(pair.Q), motion(turned_within(pair, 180.0).Q))


def test_a_turn_of_a_ball_is_rigid_and_about_the_middle_axis():
    points = torch.cat((torch.eye(3), -torch.eye(3))).double()[None] * torch.tensor([1.0, 1.0 + 1e-9, 1.0 + 2e-9])
    turned = turned_within(CloudPair(points, points, points, points), 40.0).Q
    torch.testing.assert_close(turned[0, 1], points[0, 1])
    assert math.degrees(torch.arccos(turned[0, 0] @ points[0, 0])) == pytest.approx(40, abs=1e-6)


def test_a_plane_can_be_turned():
    flat = torch.rand(1, 50, 3) * torch.tensor([3.0, 2.0, 0.0])
    turned = turned_within(CloudPair(flat, flat, flat, flat), 40.0)
    assert turned.Q.isfinite().all() and turned.Q_normals.isfinite().all()


def test_how_much_is_held_does_not_hang_on_padding():
    P, Q = bumpy(120, 3), bumpy(60, 3)
    layer = BBRLayer("N", inner=Adam(2, 1e-9))
    alone = layer(P, Q, start=STILL)
    sizes = {"P": (P, 207), "Q": (Q, 223)}
    padded = {name: torch.cat((x, x.new_zeros(n - len(x), 3))) for name, (x, n) in sizes.items()}
    masks = {f"{name}_mask": torch.arange(n) < len(x) for name, (x, n) in sizes.items()}
    found = layer(**padded, **masks, start=STILL)
    torch.testing.assert_close(found.resistance, alone.resistance)
    assert found.status == alone.status != Status.DEGENERATE


def test_padding_does_not_decide_which_stages_run():
    P, Q = bumpy(50, 3), bumpy(60, 3)
    layer = BBRLayer(Stage(SoftBD(), Adam(2)), Stage(BuddyFilter(), GaussNewton(3), above=64))
    mask = torch.arange(90) < 60
    padded = torch.cat((Q, Q.new_zeros(30, 3)))
    assert layer(P, padded, Q_mask=mask).iterations == layer(P, Q).iterations == 2
    assert layer(P, padded).iterations == 5


def test_a_size_that_no_stage_is_for_is_named(as_a_user):
    with pytest.raises(ValueError, match="no stage of the layer is for 3D clouds of up to 60 points: look at its dim"):
        BBRLayer(Stage(SoftBD(), upto=50))(bumpy(40, 3), bumpy(60, 3))
    with pytest.raises(ValueError, match="clouds of up to 55 points"):
        BBRLayer(Stage(SoftBD(), upto=50))(bumpy(40, 3), bumpy(60, 3), Q_mask=torch.arange(60) < 55)
