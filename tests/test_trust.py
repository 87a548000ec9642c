"""The confidence of an answer, and the directions that nothing holds: found and named."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.func import vmap

from bbr_layer import Adam, BBRLayer, CloudPair, Detached, RigidMotion, Status, register
from bbr_layer.confidence import COEFFICIENTS
from bbr_layer.directions import named
from bbr_layer.matches import Matches, along_normals, summed
from bbr_layer.preparation import prepared
from bbr_layer.registration import StageResult, judged
from bbr_layer.resistance import _agreed_hold
from benchmarks.reliability import fitted, loaded
from benchmarks.reliability_runs import read, row
from benchmarks.reliability_trials import trials

TABLE = Path(__file__).resolve().parent.parent / "benchmarks" / "reliability.csv"
N = 500
# The pose is already right: the last stage only, and few steps of it.
LAYER = BBRLayer("F", inner=Adam(10, 0.001), backward=Detached())
SLIDE, TURN = "sliding", "turning"


def on_sphere(rng, n):
    points = rng.normal(size=(n, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def corridor(rng, n):
    wall, across, along = rng.integers(0, 4, n), rng.uniform(-1, 1, n), rng.uniform(-4, 4, n)
    side = np.where(wall % 2 == 0, -1.0, 1.0)
    return np.stack((along, np.where(wall < 2, side, across), 1.3 * np.where(wall < 2, across, side)), axis=1)


def cylinder(rng, n):
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.stack((np.cos(angle), np.sin(angle), rng.uniform(-2, 2, n)), axis=1)


# Shape, the kinds of its free directions, and where their axes lie: (kind, axis) for those that are single.
SHAPES = {
    "plane": (lambda rng, n: rng.uniform(-1, 1, (n, 3)) * [1, 1, 0], [SLIDE, SLIDE, TURN], {TURN: [0, 0, 1]}),
    "line": (lambda rng, n: rng.uniform(-1, 1, (n, 3)) * [1, 0, 0], [SLIDE, TURN], {SLIDE: [1, 0, 0], TURN: [1, 0, 0]}),
    "sphere": (on_sphere, [TURN, TURN, TURN], {}),
    "cylinder": (cylinder, [SLIDE, TURN], {SLIDE: [0, 0, 1], TURN: [0, 0, 1]}),
    "corridor": (corridor, [SLIDE], {SLIDE: [1, 0, 0]}),
    "corridor in 2D": (
        lambda rng, n: np.stack((rng.uniform(-4, 4, n), rng.choice([-1.0, 1.0], n)), axis=1),
        [SLIDE],
        {SLIDE: [1, 0]},
    ),
    "line in 2D": (lambda rng, n: rng.uniform(-1, 1, (n, 2)) * [1, 0], [SLIDE], {SLIDE: [1, 0]}),
    "circle": (lambda rng, n: cylinder(rng, n)[:, :2], [TURN], {TURN: [0, 0, 1]}),
    "ellipsoid": (lambda rng, n: on_sphere(rng, n) * [1, 1.4, 2], [], {}),
    "box": (
        lambda rng, n: (
            np.where(np.eye(3)[rng.integers(0, 3, n)], rng.choice([-1.0, 1.0], (n, 1)), rng.uniform(-1, 1, (n, 3)))
            * [1, 1.5, 2]
        ),
        [],
        {},
    ),
    "curve in 2D": (
        lambda rng, n: (lambda x: np.stack((x, x**2 / 2 + np.sin(4 * x) / 5), 1))(rng.uniform(-1, 1, n)),
        [],
        {},
    ),
}


def samples(name, rng, noise, n=N):
    P, Q = (SHAPES[name][0](rng, n) for _ in range(2))
    return tuple(torch.from_numpy(x + noise * rng.normal(size=x.shape)) for x in (P, Q))


@pytest.mark.parametrize(("unit", "offset", "noise"), [(1.0, 0.0, 0.01), (1e3, 1e6, 0.0), (1e-3, 0.0, 0.02)])
@pytest.mark.parametrize("name", SHAPES)
def test_what_is_free_is_found_and_named(name, unit, offset, noise, rng):
    P, Q = (unit * x + offset for x in samples(name, rng, noise))
    result = LAYER(P, Q, start=RigidMotion.identity(P.shape[1]))
    found = result.weak_directions
    _, kinds, axes = SHAPES[name]
    assert sorted(direction.words.split()[0] for direction in found) == kinds, [d.words for d in result.directions]
    assert (result.status == Status.DEGENERATE) == bool(kinds)
    for direction in found:
        assert direction.free and direction.deviation == np.inf and "held by nothing" in direction.words
        kind = TURN if direction.turning else SLIDE
        if kind in axes:
            np.testing.assert_allclose(np.abs(direction.axis), axes[kind], atol=0.1)
    for direction in result.directions[len(found) :]:
        assert not direction.free and 0 <= direction.deviation < (1.0 if direction.turning else unit)
    if kinds:
        assert result.confidence == 0


def test_the_words_of_a_corridor(rng):
    P, Q = samples("corridor in 2D", rng, 0.0)
    assert LAYER(P, Q, start=RigidMotion.identity(2)).weak_directions[0].words.startswith("sliding along (1.00, 0.00)")


@pytest.mark.parametrize("name", ["ellipsoid", "box", "curve in 2D"])
def test_right_answers_have_more_confidence_than_wrong_ones(name, rng):
    P, Q = samples(name, rng, 0.0)
    d = P.shape[1]
    off = RigidMotion.from_rotvec(torch.full((2 * d - 3,), 0.5, dtype=torch.float64), torch.full((d,), 0.3).double())
    still = BBRLayer("F", inner=Adam(1, 1e-9), backward=Detached())
    right, wrong = (still(P, Q, start=start).confidence for start in (RigidMotion.identity(d), off))
    assert right > 0.9 and wrong < 0.1
    assert right.dtype == torch.float64


def test_confidence_of_a_batch_is_that_of_its_items_and_of_masks_that_of_removal(rng):
    P, Q = samples("ellipsoid", rng, 0.0, 120)
    off = Q + 0.3
    start = RigidMotion.identity(3)
    together = LAYER(torch.stack((P, P)), torch.stack((Q, off)), start=start)
    alone = [LAYER(P, x, start=start) for x in (Q, off)]
    mask = torch.arange(120) < 100
    masked = LAYER(P, torch.where(mask[:, None], Q, torch.nan), Q_mask=mask, start=start)
    removed = LAYER(P, Q[:100], start=start)
    for field in ("confidence", "resistance", "residual", "radius"):
        wanted = torch.stack([getattr(item, field) for item in alone])
        torch.testing.assert_close(getattr(together, field), wanted)
        torch.testing.assert_close(getattr(masked, field), getattr(removed, field))
    over = vmap(lambda Q: LAYER(P, Q, start=start).confidence)(torch.stack((Q, off)))
    torch.testing.assert_close(over, together.confidence)
    assert len(together.weak_directions) == len(together.directions) == 2
    assert torch.equal(pickle.loads(pickle.dumps(together)).confidence, together.confidence)
    assert together.reshape((1, 2)).confidence.shape == (1, 2)
    assert register(P.numpy(), Q.numpy(), layer=LAYER).directions


def test_confidence_has_no_gradient_and_failures_have_none_of_it(rng):
    P, Q = samples("ellipsoid", rng, 0.0, 60)
    result = BBRLayer("softBD", inner=Adam(3))(P, Q.requires_grad_())
    assert not result.confidence.requires_grad and result.loss.requires_grad
    empty = LAYER(P, Q.detach(), P_mask=torch.zeros(60, dtype=torch.bool))
    assert empty.status == Status.NO_BUDDIES and empty.confidence == 0
    nowhere = RigidMotion(torch.eye(3)[None].double(), torch.full((1, 3), torch.nan, dtype=torch.float64))
    frame, pair = prepared(CloudPair(P[None], Q.detach()[None]), False, True)
    ended = StageResult(nowhere, *torch.zeros(3, 1, dtype=torch.float64), torch.tensor([True]))
    lost = judged(pair, frame, ended, 1)
    assert lost.status.item() == Status.NON_FINITE and lost.confidence.item() == 0


def test_many_points_are_judged_by_the_same_few_each_time(rng):
    P, Q = samples("ellipsoid", rng, 0.0, 6000)
    first, again = (LAYER(P, Q, start=RigidMotion.identity(3)) for _ in range(2))
    assert torch.equal(first.confidence, again.confidence) and first.confidence > 0.9
    ratio = first.resistance.diagonal() / first.information.diagonal()
    assert (ratio > 0.7).all() and (ratio < 1.3).all()  # of all pairs, though counted on few


def test_the_coefficients_are_what_the_table_gives():
    _, right, shares, *_ = loaded(TABLE)
    np.testing.assert_allclose(fitted(shares, right), COEFFICIENTS, atol=0.05)


def test_the_table_is_what_its_command_gives(real_data):
    rows = read(TABLE)
    layer = BBRLayer(backward=Detached())
    for trial in [trial for trial in trials(4) if trial.points == 200][::16]:
        kept, found = rows[trial.name, "default"], row(trial, "default", layer)
        np.testing.assert_allclose(np.array(found[5:8], float), np.array(kept[5:8], float), atol=1e-3)


def test_a_direction_that_nothing_is_known_of_has_no_deviation_and_no_negative_share():
    assert all(np.isinf(one.deviation) for one in named(torch.eye(3).double(), 1.0, float("nan")))
    assert named(torch.diag(torch.tensor([-0.1, 1.0, 1.0]).double()), 1.0, 0.1)[0].share == 0


def test_the_error_of_the_hold_falls_with_the_root_of_the_patches():
    a, b, arms = (torch.nn.functional.normalize(torch.randn(1, 32, 3).double(), dim=-1) for _ in range(3))
    found = Matches(arms, a, b, torch.arange(32)[None], torch.ones(1, 32, dtype=torch.bool))
    ones = torch.ones(1, 32).double()
    both, apart = (summed(ones, along_normals(arms, part)) for part in found.normal_parts())
    torch.testing.assert_close(_agreed_hold(arms, found, 8)[0], both - apart / 2)
