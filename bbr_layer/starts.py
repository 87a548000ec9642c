"""Several starting rotations tried as one batch, and the one that ends best."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.pose_gradient import PairKernel
from bbr_layer.losses import BuddyFilter, SoftBBS
from bbr_layer.pair import CloudPair, Frame
from bbr_layer.rotations import rotation_dimensions
from bbr_layer.stage import SOFT_SMOOTHING, Stage
from bbr_layer.temperature import Annealed
from bbr_layer.thinning import thinned_pair

# Radians between starts. Measured: with 40 degrees to each side of every axis none of 180 registrations of the bunny,
# horse and dragon turned by 30, 60 or 90 degrees fails; benchmarks/starts.md.
TURN = math.radians(40)
# Point spacings that the soft buddies of every start but the first begin at: a start that is only near needs to see
# farther. Chosen; no benchmark compares it with others.
HOT = 8.0
# Another start replaces the first where it finds this share more buddies. Chosen by benchmarks/starts.py with other
# values put here: at 0 sparse range scans 5 degrees off fail once more in twenty, at 0.2 those 30 to 50 degrees off
# fail 7 times instead of once.
RELUCTANCE = 0.1


def most_starts(d: int) -> int:
    """How many starts there are: turns to both sides about every axis, as long as they stay below half a turn."""
    return 1 + 2 * rotation_dimensions(d) * int(math.pi // TURN)


def turns(count: int, d: int) -> Tensor:
    """No turn, then one turn to each side about each axis, then two, ``(count, d, d)`` float64."""
    axes = rotation_dimensions(d)
    vectors = torch.zeros(count, axes, dtype=torch.float64)
    for number in range(1, count):
        ring, which = divmod(number - 1, 2 * axes)
        vectors[number, which // 2] = TURN * (ring + 1) * (1 - 2 * (which % 2))
    return RigidMotion.from_rotvec(vectors, torch.zeros(count, d, dtype=torch.float64)).rotation


class Chosen(NamedTuple):
    """Where to begin, between the user's frames, and the first stage as hot as it is begun from there."""

    motion: RigidMotion
    stage: Stage


def best_start(count: int, stage: Stage, clouds: tuple[CloudPair, Frame], begun: RigidMotion) -> Chosen:
    """Run ``stage`` from ``count`` rotations about the source's centroid; the one that ended best, per item.

    Best is the lowest softBBS (Eq. 5) at one point spacing: the share of points with a buddy, which means the same
    wherever it was found; the first start stays where none is clearly better. The stage is to be run again from the
    chosen start, which gives the gradient of that run: to go on from where it ended instead would make the first steps,
    as long as ever, answer to a gradient of nearly 0.

    Parameters
    ----------
    clouds: the centred pair and its frame.
    begun: the first start, between the user's frames.

    Raises
    ------
    ValueError: more starts than there are.
    """
    pair, frame = thinned_pair(clouds[0], stage.points), clouds[1]
    batch, d = begun.translation.shape
    if count > most_starts(d):
        raise ValueError(f"starts is {count}; in {d}D there are {most_starts(d)} of them at most: try 7")
    entered = frame.enter(begun)
    turned = turns(count, d).to(entered.rotation.device) @ entered.rotation[:, None]
    with torch.no_grad():
        several = CloudPair._make(None if x is None else x.detach().repeat_interleave(count, 0) for x in pair)
        frames = Frame(*(x.detach().repeat_interleave(count, 0) for x in frame))
        places = RigidMotion(turned.reshape(-1, d, d), entered.translation.repeat_interleave(count, 0))
        hot = _heated(stage, torch.arange(count, device=turned.device).repeat(batch) > 0)
        ended = hot(several, frames, frames.leave(places), lambda step: False, closed_form=True)
        scores = torch.nan_to_num(_buddies_missing(several, frames.enter(ended.motion)), nan=torch.inf)
        scores = scores.reshape(batch, count)
        scores[:, 0] *= 1 + RELUCTANCE  # softBBS counts buddies with a minus
        chosen = scores.argmin(1)
    rotation = turned[torch.arange(batch, device=turned.device), chosen]
    return Chosen(frame.leave(RigidMotion(rotation, entered.translation)), _heated(stage, chosen > 0))


def _heated(stage: Stage, hot: Tensor) -> Stage:
    """The stage begun hotter for the ``hot`` items, where heat is what finds buddies."""
    if isinstance(stage.loss, BuddyFilter) or not isinstance(stage.temperature, Annealed):
        return stage
    own = torch.as_tensor(stage.temperature.start, dtype=torch.float64, device=hot.device)
    heats = torch.where(hot, own.clamp(min=HOT), own)
    return Stage(stage.loss, stage.inner, Annealed(heats, stage.temperature.end), stage.chart, points=stage.points)


def _buddies_missing(pair: CloudPair, motion: RigidMotion) -> Tensor:
    loss = SoftBBS(smoothing=SOFT_SMOOTHING)
    kernel = PairKernel(loss.kernel(pair), pair, loss.smoothing * pair.known_spacing().double())
    return kernel.slope(motion, loss.temperature_unit(pair).double()).loss
