"""Planar scans that seem to stand still among others that move: sought again at the sequence's own speed.

In a corridor the walls hold a scan across it alone. Things that go along with the sensor, people around a robot or the
robot's own load, then agree best without motion, free space included, and all pairs of a few scans say so. What tells
is the speed: a step whose length is unlike all others is tried at the usual length in every direction, with pairs of
a finite reach, so that what went along does not pull.
"""

import math

import torch
from torch import Tensor

from bbr_layer import RigidMotion
from train.given_motion import GAUSSIAN, RIGHT_TO
from train.pair_registration import register_pairs
from train.pose_graph import Edges
from train.scans import Progress, silent
from train.scene import Scene

# A step is unlike the others from so many deviations of their lengths on; of at most this share of all steps: where
# more are, there is no usual length. Chosen: from 3 on more of them are found among movers, but wrong loops bend the
# narrow view of benchmarks/false_loops.md.
UNLIKE, MOST = 8.0, 1 / 3
# Two scans that agree so far, of at most 1, are one view: the sensor stood.
STOOD = 0.9
# Directions of the starts.
DIRECTIONS = 12
# Answers slide along a corridor as far as the steps last: they count the less the farther they end from the usual
# length, in deviations, and from the direction of the step before, radians; beyond the last so many they do not count.
LENGTHS, TURN, FARTHEST = 2.0, math.pi / 2, 3.0
# Nor does an answer count whose score is below this part of the chain's median and of the score it would replace: a
# scan of a sensor that stood agrees with nothing a step away.
FAINT = 0.5


def at_usual_speed(scene: Scene, chain: Edges, progress: Progress = silent) -> tuple[Edges, Tensor]:
    """The chain with steps of the usual length instead of others where some fit, and which those are, ``(e,)``.

    Parameters
    ----------
    scene: planar scans.
    chain: each scan registered to the one before, in order.
    """
    lengths = torch.linalg.vector_norm(chain.target_from_source.translation, dim=-1)
    usual = lengths.median()
    deviation = (GAUSSIAN * (lengths - usual).abs().median()).clamp(min=RIGHT_TO * scene.spacing)
    unlike = ((lengths - usual).abs() > UNLIKE * deviation) & (chain.score < STOOD)
    replaced = torch.zeros_like(unlike)
    if not unlike.any() or unlike.sum() > MOST * len(lengths):
        return chain, replaced
    rows = torch.nonzero(unlike)[:, 0]
    found = _in_all_directions(scene, chain.kept(rows), usual, progress)
    least = FAINT * chain.score.clamp(max=float(chain.score.median()))
    for number, row in enumerate(rows.tolist()):
        tried = found.kept(torch.arange(number * DIRECTIONS, (number + 1) * DIRECTIONS))
        before = chain.target_from_source.translation[row - 1 if row else 1 % len(lengths)]
        worth = _worth(tried, (float(usual), float(deviation)), before)
        worth = torch.where(tried.score >= least[row], worth, 0.0)
        best = int(worth.argmax())
        if worth[best] > 0:
            chain, replaced[row] = _with(chain, row, tried.kept(torch.tensor([best]))), True
    return chain, replaced


def _in_all_directions(scene: Scene, edges: Edges, length: Tensor, progress: Progress) -> Edges:
    """Every edge registered from a step of this length in each direction, its own turn kept."""
    angles = torch.arange(DIRECTIONS, dtype=torch.float64) * (2 * math.pi / DIRECTIONS)
    steps = length * torch.stack((angles.cos(), angles.sin()), -1)
    target, source = (side.repeat_interleave(DIRECTIONS) for side in (edges.target, edges.source))
    turns = edges.target_from_source.rotation.repeat_interleave(DIRECTIONS, 0)
    start = RigidMotion(turns, steps.repeat(len(edges.target), 1))
    return register_pairs(scene, (target, source), start, 0, progress, far=False)


def _worth(tried: Edges, usual: tuple[float, float], before: Tensor) -> Tensor:
    """The scores, less where the motion is unlike its sequence's, ``(e,)``; 0 beyond ``FARTHEST``."""
    motion, (length, deviation) = tried.target_from_source.translation, usual
    own = torch.linalg.vector_norm(motion, dim=-1)
    away = (own - length).abs() / deviation
    cosine = (motion @ before) / (own * before.norm()).clamp(min=1e-300)
    turned = cosine.clamp(-1, 1).arccos()
    worth = tried.score * torch.exp(-(away / LENGTHS).square() / 2 - (turned / TURN).square() / 2)
    return torch.where(away <= FARTHEST, worth, 0.0)


def _with(chain: Edges, row: int, edge: Edges) -> Edges:
    """The chain with another edge at one place."""
    order = torch.arange(len(chain.target))
    order[row] = len(order)
    return chain.joined(edge).kept(order)
