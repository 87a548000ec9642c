"""Several starting rotations tried as one batch, and the one that ends best; then several about where that ended."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer.alike import leaders, moved_little
from bbr_layer.backward import Detached
from bbr_layer.descent import descended
from bbr_layer.fit_score import score
from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.gauss_newton import GaussNewton
from bbr_layer.losses import BuddyFilter
from bbr_layer.named_stages import FINE_POINTS
from bbr_layer.pair import CloudPair, Frame
from bbr_layer.registration import StageResult
from bbr_layer.rotations import rotation_dimensions
from bbr_layer.stage import Stage
from bbr_layer.temperature import Annealed
from bbr_layer.thinning import thinned_pair

# Radians between starts. Measured: with 40 degrees to each side of every axis none of 180 registrations of the bunny,
# horse and dragon turned by 30, 60 or 90 degrees fails; benchmarks/starts.md.
TURN = math.radians(40)
# Point spacings that the soft buddies of every start but the first begin at: a start that is only near needs to see
# farther. Chosen; no benchmark compares it with others.
HOT = 8.0
# Another start replaces the first where its score is higher by this share, so that rounding does not choose between
# starts that end alike. Chosen.
RELUCTANCE = 0.05
# Radians between starts about the best answer; the iterations, rounding in point spacings and most points of each cloud
# that they are given before the last stage. Measured beside a distractor and in partial overlap, where few pairs need
# them: benchmarks/around.md and tests/test_starts.py. Not in the plane, where whole turns decide.
AROUND, SPACE = math.radians(8), 3
AROUND_ITERATIONS, AROUND_ROUNDING, AROUND_POINTS = 8, (0.3, 0.03), FINE_POINTS


def most_starts(d: int) -> int:
    """How many starts there are: turns to both sides about every axis, as long as they stay below half a turn."""
    return 1 + 2 * rotation_dimensions(d) * int(math.pi // TURN)


def turns(count: int, d: int, turn: float = TURN) -> Float[Tensor, "count d d"]:
    """No turn, then one ``turn`` (radians) to each side about each axis, then two, float64."""
    axes = rotation_dimensions(d)
    vectors = torch.zeros(count, axes, dtype=torch.float64)
    for number in range(1, count):
        ring, which = divmod(number - 1, 2 * axes)
        vectors[number, which // 2] = turn * (ring + 1) * (1 - 2 * (which % 2))
    return RigidMotion.from_rotvec(vectors, torch.zeros(count, d, dtype=torch.float64)).rotation


class Chosen(NamedTuple):
    """Where to begin, and with what.

    Parameters
    ----------
    motion: between the user's frames.
    stages: those to run from there, the first as hot as it is begun.
    ended: where they end on the points that were tried, without a graph.
    whole: whether those are all points.
    """

    motion: RigidMotion
    stages: list[Stage]
    ended: StageResult
    whole: bool = True


def best_start(count: int, stages: list[Stage], clouds: tuple[CloudPair, Frame], begun: RigidMotion) -> Chosen:
    """Run ``stages`` from ``count`` rotations about the source's centroid; the start that ended best, per item.

    All of them see only the points of the second one, where F begins. Best is the most buddies that lie on each other's
    planes, counted softly: of a wrong answer many points have a buddy, but few fit. Without normals it is the lowest
    softBBS (Eq. 5) at one point spacing. The first start stays where none is clearly better.

    Where the stages end, in space, with an F of finite reach, its iterations are then begun from rotations about the
    best answer in the same way: F from afar has pulled some of them past the right one. Not with features, whose
    gradient soft buddies alone have. Of more points than were tried the stages that see more go on from where it
    ended.

    The stages are to be run again from the chosen start, which gives the gradient of that run: to go on with steps of
    Adam from where it ended instead would make the first ones, as long as ever, answer to a gradient of nearly 0.

    Parameters
    ----------
    stages: at least one; the first is begun hotter from every start but the first.
    clouds: the centred pair and its frame.
    begun: the first start, between the user's frames.

    Raises
    ------
    ValueError: more starts than there are.
    """
    d = clouds[0].P.shape[-1]
    if count > most_starts(d):
        raise ValueError(f"starts is {count}; in {d}D there are {most_starts(d)} of them at most: try 7")
    few = _tried_points(stages)
    tried = thinned_pair(clouds[0], few)
    whole = tried.P.shape == clouds[0].P.shape and tried.Q.shape == clouds[0].Q.shape
    found = _best_turn(stages, (tried, clouds[1]), begun, turns(count, d))
    loss = stages[-1].loss
    if d == SPACE and isinstance(loss, BuddyFilter) and math.isfinite(loss.reach) and tried.P_features is None:
        inner, rounding = GaussNewton(AROUND_ITERATIONS), Annealed(*AROUND_ROUNDING)
        around = Stage(BuddyFilter(reach=loss.reach), inner, rounding, points=AROUND_POINTS)
        near = turns(1 + 2 * rotation_dimensions(d), d, AROUND)
        found = _best_turn([around, stages[-1]], (tried, clouds[1]), found.ended.motion, near)
        if few and not whole:
            later = [stage for stage in stages if stage.points is None or stage.points > few]
            found = found._replace(motion=found.ended.motion, stages=later or stages[-1:])
    return found._replace(whole=whole)


def _best_turn(
    stages: list[Stage], clouds: tuple[CloudPair, Frame], begun: RigidMotion, rotations: Float[Tensor, "count d d"]
) -> Chosen:
    """Run the stages from every rotation of the source about its centroid; the best for each item."""
    (pair, frame), (count, d, _) = clouds, rotations.shape
    entered = frame.enter(begun)
    batch, device = len(entered.rotation), entered.rotation.device
    turned = rotations.to(device) @ entered.rotation[:, None]
    with torch.no_grad():
        several = CloudPair._make(None if x is None else x.detach().repeat_interleave(count, 0) for x in pair)
        frames = Frame(*(x.detach().repeat_interleave(count, 0) for x in frame))
        places = RigidMotion(turned.reshape(-1, d, d), entered.translation.repeat_interleave(count, 0))
        hot = _heated(stages[0], torch.arange(count, device=device).repeat(batch) > 0)
        run = [hot, *(stage for stage in stages[1:] if stage.wanted(several))]
        ended, scores = _tried(run, (several, frames), frames.leave(places), count)
        scores = scores.nan_to_num(nan=-torch.inf).reshape(batch, count)
        scores[:, 0] *= 1 + RELUCTANCE
        chosen = scores.argmax(1)
    items = torch.arange(batch, device=device)
    motion = frame.leave(RigidMotion(turned[items, chosen], entered.translation))
    return Chosen(motion, [_heated(stages[0], chosen > 0), *stages[1:]], _of(ended, items * count + chosen))


def _tried_points(stages: list[Stage]) -> int | None:
    """How many points the later of the first two stages sees that does not see all; None where both do."""
    few = [stage.points for stage in stages[:2] if stage.points is not None]
    return few[-1] if few else None


def _tried(
    run: list[Stage], clouds: tuple[CloudPair, Frame], begun: RigidMotion, count: int
) -> tuple[StageResult, Tensor]:
    """Where the stages end from each of ``count`` starts per item, and the scores there.

    Of starts that the first stage brings to the same place one goes on for all.
    """
    pair, frame = clouds
    ended = descended(run[:1], clouds, begun, Detached())
    if len(run) == 1:
        return ended, score(pair, frame.enter(ended.motion))
    rotation, translation = (x.unflatten(0, (-1, count)) for x in frame.enter(ended.motion))
    one, other = RigidMotion(rotation[:, :, None], translation[:, :, None]), (rotation[:, None], translation[:, None])
    first = leaders(moved_little(one, RigidMotion(*other), _rows(pair, slice(None, None, count))))
    first = first + count * torch.arange(len(first), device=first.device)[:, None]
    kept, followed = first.flatten().unique(return_inverse=True)
    pair, frame = _rows(pair, kept), Frame(*(x[kept] for x in frame))
    ended = descended(run[1:], (pair, frame), ended.motion.item(kept), Detached())
    return _of(ended, followed), score(pair, frame.enter(ended.motion))[followed]


def _rows(pair: CloudPair, rows: Tensor | slice) -> CloudPair:
    """Some items of a pair."""
    return CloudPair._make(None if x is None else x[rows] for x in pair)


def _of(ended: StageResult, rows: Tensor) -> StageResult:
    """Some items of a result."""
    loss, temperature, gradient_norm, settled = (x[rows] for x in ended[1:])
    return StageResult(ended.motion.item(rows), loss, temperature, gradient_norm, settled)


def _heated(stage: Stage, hot: Tensor) -> Stage:
    """The stage begun hotter for the ``hot`` items, where heat is what finds buddies."""
    if isinstance(stage.loss, BuddyFilter) or not isinstance(stage.temperature, Annealed):
        return stage
    own = torch.as_tensor(stage.temperature.start, dtype=torch.float64, device=hot.device)
    heats = torch.where(hot, own.clamp(min=HOT), own)
    cooling = Annealed(heats, stage.temperature.end)
    return Stage(stage.loss, stage.inner, cooling, stage.chart, points=stage.points, dimension=stage.dimension)
