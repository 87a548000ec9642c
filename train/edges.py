"""Which scans are compared with which, and what the layer answers: chain, window, loops, pose graph."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer import Adam, BBRLayer, Detached, RigidMotion
from train.config import EdgeConfig
from train.pose_graph import Edges, chained, solve_pose_graph
from train.prepared import Prepared, prepare
from train.scans import Progress, ScanSet, silent

# Pairs registered as one batch, and between two reports of progress.
BATCH = 32
# An edge whose share of mutual pairs is below this part of the chain's median is sought again from other starts.
POOR = 0.6
# F's steps and first rate: benchmarks/mapping_sequences.md has the errors; 60 at 0.02 left more than twice that of
# v1_pose0. Twice the layer's own rate, as scans lie farther apart than what soft buddies leave.
EDGE_STEPS, EDGE_RATE = 200, 0.01
# Turns tried for such an edge, radians about the vertical axis: measured, they win sequences of one scan a second.
YAW_STARTS = np.deg2rad([0.0, 30.0, -30.0, 60.0, -60.0, 90.0, -90.0])
# Points of a scan that soft buddies, whose cost grows with their square, are given.
SOFT_POINTS = 400
# A loop counts when its score reaches this part of the chain's median; absolute thresholds reject whole sequences.
LOOP_SCORE = 0.8
# Loop candidates lie within this part of the median scan radius of each other, and this many windows apart in time.
LOOP_REACH = 0.5
LOOP_WINDOWS = 3


def register_edges(scans: ScanSet, config: EdgeConfig, progress: Progress = silent) -> tuple[Edges, RigidMotion]:
    """Register neighbouring scans with the layer, close loops, and solve for the poses.

    Parameters
    ----------
    scans: k scans; given starting poses are used, otherwise every scan is first compared in place with the last.
    config: window, loops and points.
    progress: told ``(stage, done, total)``.

    Returns
    -------
    The edges that were believed, and ``world_from_scan (k, ...)``; the first pose is the given one, or the identity.
    """
    prepared = prepare(scans, config.points)
    edges = _consecutive(prepared, scans, progress)
    poses = chained(edges, len(scans))
    poses = _anchored(poses, scans)
    if (steps := min(config.window, len(scans) - 1)) > 1:
        edges = edges.joined(_window(prepared, poses, steps, progress))
    poses, weights = solve_pose_graph(edges, poses)
    for _ in range(config.rounds if config.loops_per_scan else 0):
        loops = _loops(prepared, poses, edges, config, progress)
        if loops is None:
            break
        edges = edges.kept(edges.kind < 2).joined(loops)
        poses, weights = solve_pose_graph(edges, poses)
    return edges._replace(score=edges.score * weights), poses


def _consecutive(prepared: Prepared, scans: ScanSet, progress: Progress) -> Edges:
    """Each scan with the one before, in place or at the given poses; poor answers are sought again, turned."""
    target = torch.arange(len(scans) - 1)
    start = RigidMotion.identity(scans.dimension, (len(target),))
    if scans.start is not None:
        world = RigidMotion.from_matrix(torch.from_numpy(scans.start))
        start = world.item(target).inverse() @ world.item(target + 1)
    edges = register_pairs(prepared, (target, target + 1), start, 0, progress)
    poor = torch.nonzero(edges.score < POOR * edges.score.median())[:, 0]
    if not len(poor):
        return edges
    again = _from_turned_starts(prepared, edges.kept(poor), start.item(poor), progress)
    better = again.score > edges.score[poor]
    untouched = torch.ones(len(target), dtype=torch.bool)
    untouched[poor[better]] = False
    return edges.kept(untouched).joined(again.kept(better))


def _from_turned_starts(prepared: Prepared, edges: Edges, start: RigidMotion, progress: Progress) -> Edges:
    """The best answer of several turned starts, soft buddies first, by share of mutual pairs."""
    d = prepared.points.shape[-1]
    best = edges
    for yaw in YAW_STARTS.tolist():
        turn = torch.zeros(1 if d == 2 else 3, dtype=torch.float64)
        turn[-1] = yaw
        turned = start @ RigidMotion.from_rotvec(turn, torch.zeros(d, dtype=torch.float64))
        near = _softly(prepared, edges.target, edges.source, turned)
        tried = register_pairs(prepared, (edges.target, edges.source), near, 0, progress)
        better = tried.score > best.score
        joined = best.joined(tried)
        best = joined.kept(torch.arange(len(better)) + len(better) * better)
    return best


def _window(prepared: Prepared, poses: RigidMotion, window: int, progress: Progress) -> Edges:
    """Each scan with those up to ``window`` later, from the chain's poses."""
    k = len(prepared.points)
    pairs = [(i, i + step) for step in range(2, window + 1) for i in range(k - step)]
    target, source = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).unbind(1)
    start = poses.item(target).inverse() @ poses.item(source)
    return register_pairs(prepared, (target, source), start, 1, progress)


def _loops(
    prepared: Prepared, poses: RigidMotion, edges: Edges, config: EdgeConfig, progress: Progress
) -> Edges | None:
    """Scans that the current poses put close together though far apart in time; None where there are none."""
    places = poses.translation.numpy()
    radius = torch.linalg.vector_norm(prepared.points, dim=-1)[prepared.mask].median().item()
    apart = LOOP_WINDOWS * max(config.window, 2)
    pairs = []
    for i, near in enumerate(cKDTree(places).query_ball_point(places, LOOP_REACH * radius)):
        distances = np.linalg.norm(places - places[i], axis=1)
        later = sorted((j for j in near if j >= i + apart), key=distances.__getitem__)
        pairs += [(i, j) for j in later[:: max(1, len(later) // max(config.loops_per_scan, 1))]][
            : config.loops_per_scan
        ]
    if not pairs:
        return None
    target, source = torch.tensor(pairs).unbind(1)
    start = poses.item(target).inverse() @ poses.item(source)
    found = register_pairs(prepared, (target, source), start, 2, progress)
    good = found.score >= LOOP_SCORE * edges.score[edges.kind == 0].median()
    return found.kept(good) if good.any() else None


@torch.no_grad()
def _softly(prepared: Prepared, target: Tensor, source: Tensor, start: RigidMotion) -> RigidMotion:
    """Soft buddies' answer on few points: rough, from far away."""
    stride = max(1, prepared.points.shape[1] // SOFT_POINTS)
    points, mask = prepared.points[:, ::stride], prepared.mask[:, ::stride]
    layer = BBRLayer("softBBS", backward=Detached())
    return layer(
        points[target], points[source], P_mask=mask[target], Q_mask=mask[source], start=start
    ).target_from_source


STAGE_NAMES = {0: "consecutive scans", 1: "window", 2: "loops"}


@torch.no_grad()
def register_pairs(
    prepared: Prepared, pairs: tuple[Tensor, Tensor], start: RigidMotion, kind: int, progress: Progress = silent
) -> Edges:
    """Register scan ``source[e]`` onto scan ``target[e]`` of ``pairs = (target, source)`` for every e, in batches.

    By F alone, which holds on where the start is near and does not slide along corridors.
    """
    target, source = pairs
    layer = BBRLayer("F", inner=Adam(EDGE_STEPS, EDGE_RATE), backward=Detached())
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
                start=start.item(slice(begin, begin + BATCH)),
            )
        )
    progress(STAGE_NAMES[kind], len(target), len(target))
    motion = RigidMotion(*(torch.cat([r.target_from_source[f] for r in results]) for f in range(2)))
    buddies = torch.cat([r.buddies for r in results]).double()
    sizes = prepared.mask.sum(1)
    real = prepared.mask[source].double()[..., None]
    centre = (prepared.points[source].double() * real).sum(1) / real.sum(1)
    information = torch.cat([r.information for r in results]) / buddies.clamp(min=1)[:, None, None]
    score = buddies / torch.minimum(sizes[target], sizes[source])
    return Edges(target, source, motion, information, centre, score, torch.full_like(target, kind))


def _anchored(poses: RigidMotion, scans: ScanSet) -> RigidMotion:
    """The chain laid onto the first given pose, if poses were given."""
    if scans.start is None:
        return poses
    first = RigidMotion.from_matrix(torch.from_numpy(scans.start[0]))
    return first @ poses.item(0).inverse() @ poses
