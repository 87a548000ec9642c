"""Pairs of scans registered by the layer, in batches, from the starts given or from those that features suggest."""

import numpy as np
import torch
from torch import Tensor

from bbr_layer import Adam, Annealed, BBRLayer, BuddyFilter, Detached, RigidMotion, Stage
from train.consensus import consensus
from train.pose_graph import Edges
from train.scans import Progress, silent
from train.scene import Scene, scores
from train.shape_features import matched

# Pairs registered as one batch, and between two reports of progress.
BATCH = 32
# F's steps and first rate, twice the layer's own. With half as many for window and loops the narrow view of
# benchmarks/mapping_table.md ends 3.3 px off instead of below 1.
EDGE_STEPS, EDGE_RATE = 200, 0.01
# Of edges that begin near: reach in temperatures, first rate, and rounding in point spacings, as the default
# layer's F has them.
NEAR_REACH, NEAR_RATE, NEAR_ROUNDING = 50.0, 0.005, (0.3, 0.03)
# Points of a scan that soft buddies, whose cost grows with their square, are given.
SOFT_POINTS = 400
# Matches of features that are asked for a common motion, within this many spacings, and motions tried.
MATCHES, TOLERANCE, MOTIONS = 1000, 1.5, 2

STAGE_NAMES = {0: "consecutive scans", 1: "window", 2: "loops"}

# Weights of the points of each scan, padded, ``(k, n)``; None: all alike.
PointWeights = Tensor | None


@torch.no_grad()
def register_pairs(
    scene: Scene,
    pairs: tuple[Tensor, Tensor],
    start: RigidMotion,
    kind: int,
    progress: Progress = silent,
    *,
    weights: PointWeights = None,
    far: bool = True,
) -> Edges:
    """Register scan ``source[e]`` onto scan ``target[e]`` of ``pairs = (target, source)`` for every e, in batches.

    By F alone, which holds on where the start is near and does not slide along corridors. Unless ``far``, with pairs of
    a finite reach: for starts within a few point spacings, among things that moved.
    """
    target, source = pairs
    prepared = scene.prepared
    layer = _layer(far)
    results = []
    for begin in range(0, len(target), BATCH):
        progress(STAGE_NAMES[kind], begin, len(target))
        i, j = target[begin : begin + BATCH], source[begin : begin + BATCH]
        results.append(
            layer(
                prepared.points[i],
                prepared.points[j],
                P_normals=prepared.normals[i],
                Q_normals=prepared.normals[j],
                P_mask=prepared.mask[i],
                Q_mask=prepared.mask[j],
                P_weights=None if weights is None else weights[i],
                Q_weights=None if weights is None else weights[j],
                start=start.item(slice(begin, begin + BATCH)),
            )
        )
    progress(STAGE_NAMES[kind], len(target), len(target))
    motion = RigidMotion(*(torch.cat([r.target_from_source[f] for r in results]) for f in range(2)))
    buddies = torch.cat([r.buddies for r in results]).double()
    real = prepared.mask[source].double()[..., None]
    centre = (prepared.points[source].double() * real).sum(1) / real.sum(1)
    information = torch.cat([r.information for r in results]) / buddies.clamp(min=1)[:, None, None]
    score = scores(scene, pairs, motion)
    return Edges(target, source, motion, information, centre, score, torch.full_like(target, kind))


def _layer(far: bool) -> BBRLayer:
    if far:
        return BBRLayer("F", inner=Adam(EDGE_STEPS, EDGE_RATE), backward=Detached())
    loss, inner, cooling = BuddyFilter(reach=NEAR_REACH), Adam(EDGE_STEPS, NEAR_RATE), Annealed(*NEAR_ROUNDING)
    return BBRLayer(Stage(loss, inner, cooling), backward=Detached())


def by_features(scene: Scene, pairs: tuple[Tensor, Tensor], kind: int, progress: Progress = silent) -> Edges:
    """The best registration of each pair among the motions that most of its matched features agree on.

    Pairs without any such motion are left out; without pairs, or in the plane, there are no edges.
    """
    numbers, motions = [], []
    for edge, (i, j) in enumerate(zip(*(side.tolist() for side in pairs), strict=True)):
        both = matched(scene.features[i], scene.features[j], MATCHES)
        ends = scene.surfaces[i].points[both[:, 0]], scene.surfaces[j].points[both[:, 1]]
        found = consensus(*ends, TOLERANCE * scene.spacing, MOTIONS)
        numbers += [edge] * len(found)
        motions += found
        progress("features", edge + 1, len(pairs[0]))
    which = torch.tensor(numbers)
    start = RigidMotion.from_matrix(torch.from_numpy(np.stack(motions)))
    tried = register_pairs(scene, (pairs[0][which], pairs[1][which]), start, kind, progress)
    best = [int(torch.argmax(torch.where(which == edge, tried.score, -1.0))) for edge in sorted(set(numbers))]
    return tried.kept(torch.tensor(best))


@torch.no_grad()
def softly(scene: Scene, pairs: tuple[Tensor, Tensor], start: RigidMotion) -> RigidMotion:
    """Soft buddies' answer on few points: rough, from far away."""
    prepared, (target, source) = scene.prepared, pairs
    stride = max(1, prepared.points.shape[1] // SOFT_POINTS)
    points, mask = prepared.points[:, ::stride], prepared.mask[:, ::stride]
    layer = BBRLayer("softBBS", backward=Detached())
    return layer(
        points[target], points[source], P_mask=mask[target], Q_mask=mask[source], start=start
    ).target_from_source


def better(one: Edges, other: Edges) -> Edges:
    """The better of two registrations of each pair, both in the same order; the first where they are equal."""
    count = len(one.score)
    return one.joined(other).kept(torch.arange(count) + count * (other.score > one.score))
