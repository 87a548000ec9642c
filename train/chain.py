"""The first edges, found without any poses: each scan with the one before; few scans in space all with all."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bbr_layer import RigidMotion
from train.pair_registration import better, by_features, register_pairs, softly
from train.pose_graph import Edges
from train.scans import Progress, ScanSet
from train.scene import Scene, apart

# An edge whose score is below this part of the chain's median is sought again from other starts.
POOR = 0.6
# Turns tried for such an edge, radians about the vertical axis: measured, they win sequences of one scan a second.
YAW_STARTS = np.deg2rad([0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0])
# Scans before and after whose motions an edge's own is held against, and how many spacings apart at the scan's radius
# they may be before the edge is tried from theirs.
NEIGHBOURS, UNLIKE = 2, 5.0
# All pairs of scans further apart than neighbours are believed from this part of the chain's median score.
FOUND = 0.5


def consecutive(scene: Scene, scans: ScanSet, progress: Progress) -> Edges:
    """Each scan with the one before, in place or at the given poses; doubtful answers are sought again elsewhere."""
    target = torch.arange(len(scans) - 1)
    start = RigidMotion.identity(scans.dimension, (len(target),))
    if scans.start is not None:
        world = RigidMotion.from_matrix(torch.from_numpy(scans.start))
        start = world.between(target, target + 1)
    edges = register_pairs(scene, (target, target + 1), start, 0, progress)
    if scene.features:
        edges = better(edges, by_features(scene, (target, target + 1), 0, progress))
    likely = _motions_around(edges.target_from_source)
    unlike = apart(scene, edges.source, edges.target_from_source, likely) > UNLIKE * scene.spacing
    edges = _tried(edges, unlike, lambda few, rows: _from(scene, few, likely.item(rows), progress))
    poor = edges.score < POOR * edges.score.median()
    return _tried(edges, poor, lambda few, rows: _from_turned_starts(scene, few, start.item(rows), progress))


def all_pairs(scene: Scene, chain: Edges, progress: Progress) -> Edges:
    """Every pair of scans that are no neighbours, by features; those whose score is good beside the chain's."""
    k = len(scene.surfaces)
    pairs = torch.combinations(torch.arange(k))
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > 1]
    if not len(pairs):
        return chain.kept(chain.kind < 0)
    found = by_features(scene, (pairs[:, 0], pairs[:, 1]), 2, progress)
    return found.kept(found.score > FOUND * torch.quantile(chain.score, 0.5))


def _tried(edges: Edges, doubtful: Tensor, again: Callable[[Edges, Tensor], Edges]) -> Edges:
    """The edges, the ``doubtful`` ones replaced where ``again(edges, rows)`` finds better ones."""
    rows = torch.nonzero(doubtful)[:, 0]
    if not len(rows):
        return edges
    few = edges.kept(rows)
    order = torch.cat((torch.nonzero(~doubtful)[:, 0], rows)).argsort()
    return edges.kept(~doubtful).joined(better(few, again(few, rows))).kept(order)


def _from(scene: Scene, edges: Edges, start: RigidMotion, progress: Progress) -> Edges:
    return register_pairs(scene, (edges.target, edges.source), start, 0, progress)


def _motions_around(motion: RigidMotion) -> RigidMotion:
    """For each edge the median motion, number by number, of the edges before and after it; itself left out."""
    vectors = torch.cat((motion.rotvec, motion.translation), -1)
    count, d = len(vectors), motion.dimension
    around = []
    for edge in range(count):
        rows = [row for row in range(edge - NEIGHBOURS, edge + NEIGHBOURS + 1) if row != edge and 0 <= row < count]
        around.append(vectors[rows].median(0).values if rows else vectors[edge])
    found = torch.stack(around)
    return RigidMotion.from_rotvec(found[:, :-d], found[:, -d:])


def _from_turned_starts(scene: Scene, edges: Edges, start: RigidMotion, progress: Progress) -> Edges:
    """The best answer of several turned starts, soft buddies first."""
    d = scene.prepared.points.shape[-1]
    best = edges
    for yaw in YAW_STARTS.tolist():
        turn = torch.zeros(1 if d == 2 else 3, dtype=torch.float64)
        turn[-1] = yaw
        turned = start @ RigidMotion.from_rotvec(turn, torch.zeros(d, dtype=torch.float64))
        near = softly(scene, (edges.target, edges.source), turned)
        best = better(best, _from(scene, edges, near, progress))
    return best
