"""Scans to poses: neighbours, window and loops registered by the layer, a pose graph, a refinement of all poses."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer import RigidMotion
from train.chain import POOR, all_pairs, consecutive
from train.config import EdgeConfig
from train.free_space_evidence import point_evidence
from train.pair_registration import PointWeights, better, register_pairs
from train.pose_graph import Edges, solve_pose_graph, spanning_poses
from train.prepared import Prepared, prepare, thinned
from train.recognition import recognised
from train.refinement import refine
from train.scans import Progress, ScanSet, silent
from train.scene import Scene, build_scene
from train.surfaces import surfaces

# A loop counts when its score reaches this part of the chain's median; absolute thresholds reject whole sequences.
LOOP_SCORE = 0.8
# Loop candidates lie within this part of the median scan radius of each other, and this many windows apart in time.
LOOP_REACH = 0.5
LOOP_WINDOWS = 3
# Of up to so many scans in space all pairs are sought by features when their chain is broken: they came in any order.
FEW_SCANS = 20
# Edges that the graph believes less are sought again from its poses, and count in the refinement only above this.
DOUBTED = 0.3


def register_edges(scans: ScanSet, config: EdgeConfig, progress: Progress = silent) -> tuple[Edges, RigidMotion]:
    """Register neighbouring scans with the layer, close loops, solve for the poses and refine them together.

    Parameters
    ----------
    scans: k scans; given starting poses are used, otherwise every scan is first compared in place with the last.
    config: window, loops and points.
    progress: told ``(stage, done, total)``.

    Returns
    -------
    The edges, their score the lower the less they were believed, and ``world_from_scan (k, ...)``; the first pose is
    the given one, or the identity.
    """
    full = prepare(scans, max(config.points, config.refined_points))
    scene = build_scene(scans, thinned(full, config.points))
    edges = consecutive(scene, scans, progress)
    broken = bool((edges.score < POOR * edges.score.median()).any())
    if scene.features and broken and len(scans) <= FEW_SCANS:
        edges = edges.joined(all_pairs(scene, edges, progress))
    poses, belief = solve_pose_graph(edges, _anchored(spanning_poses(edges, len(scans)), scans))
    if (steps := min(config.window, len(scans) - 1)) > 1:
        edges = edges.joined(_window(scene, poses, steps, progress))
        poses, belief = solve_pose_graph(edges, poses)
    if scans.dimension == 2 and broken and config.loops_per_scan:
        edges = edges.joined(recognised(scene, edges, poses, LOOP_WINDOWS * max(config.window, 2), progress))
        poses, belief = solve_pose_graph(edges, poses)
    for _ in range(config.rounds if config.loops_per_scan else 0):
        weights = _point_weights(scene, edges, poses)
        edges = _again(scene, edges, belief, poses, weights)
        edges = edges.kept((edges.kind < 2) | (belief >= DOUBTED))
        edges = edges.joined(_loops(scene, poses, edges, config, progress, weights=weights))
        poses, belief = solve_pose_graph(edges, poses)
    edges = edges._replace(score=edges.score * belief)
    return edges, _refined(full, scene, (edges, belief), poses, progress)


def _window(scene: Scene, poses: RigidMotion, window: int, progress: Progress) -> Edges:
    """Each scan with those up to ``window`` later, from the poses so far."""
    k = len(scene.surfaces)
    pairs = [(i, i + step) for step in range(2, window + 1) for i in range(k - step)]
    target, source = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2).unbind(1)
    start = poses.item(target).inverse() @ poses.item(source)
    return register_pairs(scene, (target, source), start, 1, progress)


def _again(scene: Scene, edges: Edges, belief: Tensor, poses: RigidMotion, weights: PointWeights) -> Edges:
    """The edges, those that the graph did not believe registered anew from its poses, where that is not worse."""
    doubted = torch.nonzero((belief < DOUBTED) & (edges.kind < 2))[:, 0]
    if not len(doubted):
        return edges
    few = edges.kept(doubted)
    start = poses.item(few.target).inverse() @ poses.item(few.source)
    found = register_pairs(scene, (few.target, few.source), start, 1, weights=weights)._replace(kind=few.kind)
    rest = torch.ones(len(edges.score), dtype=torch.bool)
    rest[doubted] = False
    order = torch.cat((torch.nonzero(rest)[:, 0], doubted)).argsort()
    return edges.kept(rest).joined(better(found, few)).kept(order)


def _loops(
    scene: Scene,
    poses: RigidMotion,
    edges: Edges,
    config: EdgeConfig,
    progress: Progress,
    *,
    weights: PointWeights,
) -> Edges:
    """Scans that the poses put close together though far apart in time, not joined yet, as far as they agree."""
    places = poses.translation.numpy()
    prepared = scene.prepared
    radius = torch.linalg.vector_norm(prepared.points, dim=-1)[prepared.mask].median().item()
    apart = LOOP_WINDOWS * max(config.window, 2)
    joined = set(zip(edges.target.tolist(), edges.source.tolist(), strict=True))
    pairs = []
    for i, near in enumerate(cKDTree(places).query_ball_point(places, LOOP_REACH * radius)):
        distances = np.linalg.norm(places - places[i], axis=1)
        later = sorted((j for j in near if j >= i + apart), key=distances.__getitem__)
        spread = later[:: max(1, len(later) // max(config.loops_per_scan, 1))]
        pairs += [(i, j) for j in spread[: config.loops_per_scan] if (i, j) not in joined]
    if not pairs:
        return edges.kept(edges.kind < 0)
    target, source = torch.tensor(pairs).unbind(1)
    start = poses.item(target).inverse() @ poses.item(source)
    found = register_pairs(scene, (target, source), start, 2, progress, weights=weights)
    return found.kept(found.score >= LOOP_SCORE * edges.score[edges.kind == 0].median())


def _point_weights(scene: Scene, edges: Edges, poses: RigidMotion) -> PointWeights:
    """How far every point is believed to stand still, padded ``(k, n)``; None where nothing is seen from the origin."""
    if scene.views[0] is None:
        return None
    clouds = [scan.points for scan in scene.surfaces]
    pairs = torch.stack((edges.target, edges.source), 1).numpy()
    evidence = point_evidence(clouds, (scene.surfaces, scene.views), pairs, poses.matrix.numpy())
    return torch.nn.utils.rnn.pad_sequence([torch.from_numpy(one.weight).float() for one in evidence], batch_first=True)


def _refined(
    full: Prepared, scene: Scene, graph: tuple[Edges, Tensor], poses: RigidMotion, progress: Progress
) -> RigidMotion:
    """Poses at which all scans' points agree; ``graph``: the edges, and how far each was believed."""
    edges, belief = graph
    clouds = surfaces(full)
    pairs = torch.stack((edges.target, edges.source), 1).numpy()
    found = poses.matrix.numpy()
    evidence = point_evidence([scan.points for scan in clouds], (scene.surfaces, scene.views), pairs, found)
    trust = torch.where(belief > DOUBTED, belief, 0.0).numpy()
    refined = refine(clouds, pairs, found, (trust, [one.weight for one in evidence]), progress)
    return RigidMotion.from_matrix(torch.from_numpy(refined))


def _anchored(poses: RigidMotion, scans: ScanSet) -> RigidMotion:
    """The poses laid onto the first given one, if poses were given."""
    if scans.start is None:
        return poses
    first = RigidMotion.from_matrix(torch.from_numpy(scans.start[0]))
    return first @ poses.item(0).inverse() @ poses
