"""Edges sought from the poses so far: loops between scans that they put close together, and doubted edges again."""

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer import RigidMotion
from train.config import EdgeConfig
from train.free_space_evidence import point_evidence
from train.pair_registration import PointWeights, better, register_pairs
from train.pose_graph import Edges
from train.scans import Progress
from train.scene import Scene

# A loop counts when its score reaches this part of the chain's median; absolute thresholds reject whole sequences.
LOOP_SCORE = 0.8
# Loop candidates lie within this part of the median scan radius of each other, and this many windows apart in time.
LOOP_REACH = 0.5
LOOP_WINDOWS = 3
# Two scans are tried as a loop where each looked in the direction of this part of the other's points. Chosen: scans
# that look away from each other more hardly ever agree, and each costs a registration.
LOOKED_AT = 0.4
# Edges that the graph believes less are sought again from its poses, and count in the refinement only above this.
DOUBTED = 0.3


def apart_in_time(config: EdgeConfig) -> int:
    """Scans that are fewer numbers apart than this are no loop."""
    return LOOP_WINDOWS * max(config.window, 2)


def again(scene: Scene, edges: Edges, belief: Tensor, poses: RigidMotion, weights: PointWeights) -> Edges:
    """The edges, those that the graph did not believe registered anew from its poses, where that is not worse."""
    doubted = torch.nonzero((belief < DOUBTED) & (edges.kind < 2))[:, 0]
    if not len(doubted):
        return edges
    few = edges.kept(doubted)
    start = poses.between(few.target, few.source)
    found = register_pairs(scene, (few.target, few.source), start, 1, weights=weights)._replace(kind=few.kind)
    rest = torch.ones(len(edges.score), dtype=torch.bool)
    rest[doubted] = False
    order = torch.cat((torch.nonzero(rest)[:, 0], doubted)).argsort()
    return edges.kept(rest).joined(better(found, few)).kept(order)


def loops(
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
    joined = set(zip(edges.target.tolist(), edges.source.tolist(), strict=True))
    pairs = []
    for i, near in enumerate(cKDTree(places).query_ball_point(places, reach(scene))):
        distances = np.linalg.norm(places - places[i], axis=1)
        later = sorted((j for j in near if j >= i + apart_in_time(config)), key=distances.__getitem__)
        spread = later[:: max(1, len(later) // max(config.loops_per_scan, 1))]
        pairs += [(i, j) for j in spread[: config.loops_per_scan] if (i, j) not in joined]
    pairs = [pair for pair in pairs if _look_at_each_other(scene, poses, pair)]
    if not pairs:
        return edges.kept(edges.kind < 0)
    target, source = torch.tensor(pairs).unbind(1)
    start = poses.between(target, source)
    found = register_pairs(scene, (target, source), start, 2, progress, weights=weights)
    return found.kept(found.score >= LOOP_SCORE * edges.score[edges.kind == 0].median())


def _look_at_each_other(scene: Scene, poses: RigidMotion, pair: tuple[int, int]) -> bool:
    """Whether both scans looked to where the other's points are; True where nothing is seen from the origin."""
    for here, there in (pair, pair[::-1]):
        view, points = scene.views[here], torch.from_numpy(scene.surfaces[there].points)
        if view is not None and view.looked_at(poses.between(here, there)(points).numpy()).mean() < LOOKED_AT:
            return False
    return True


def reach(scene: Scene) -> float:
    """How near each other the places of two scans lie that may see the same, in the data's unit."""
    points, _, mask = scene.prepared
    return LOOP_REACH * torch.linalg.vector_norm(points, dim=-1)[mask].median().item()


def point_weights(scene: Scene, edges: Edges, poses: RigidMotion) -> PointWeights:
    """How far every point is believed to stand still, padded ``(k, n)``; None where nothing is seen from the origin."""
    if scene.views[0] is None:
        return None
    clouds = [scan.points for scan in scene.surfaces]
    pairs = torch.stack((edges.target, edges.source), 1).numpy()
    evidence = point_evidence(clouds, (scene.surfaces, scene.views), pairs, poses.matrix.numpy())
    return torch.nn.utils.rnn.pad_sequence([torch.from_numpy(one.weight).float() for one in evidence], batch_first=True)
