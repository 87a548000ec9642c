"""Poses from edges of which some are wrong: of several solutions the one whose poses make the scans agree best.

The robust pose graph has many minima, and which one it finds hangs on the order in which edges lose their weight. Begun
wide, it forgives a start that is far off, but every wrong edge bends the poses at first. Begun near a start, each edge
as strong as its score, it holds on to a good start, and clings to a bad one. The scans say which is right, those above
all that no edge joins: an edge speaks for itself.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer import RigidMotion
from train.given_motion import GIVEN
from train.loops import reach
from train.pose_graph import Edges, solve_pose_graph
from train.scene import Scene, apart, scores

# An edge at this share of the median score or below still pulls as one at this share does.
FAINTEST = 0.05
# Witnesses of a solution: each scan with its nearest ones, and at most so many pairs in all.
NEAREST, MOST = 16, 300
# What a pair counts that an edge joins, another one counting 1: the edge's own motion was sought for its score.
JOINED = 0.5
# Motions that place the two scans of a pair within so many point spacings of each other are alike.
ALIKE = 0.3


def agreed_poses(scene: Scene, edges: Edges, starts: Sequence[RigidMotion]) -> tuple[RigidMotion, Tensor]:
    """Poses that the edges agree on, and how much each edge was believed, ``(e,)`` in [0, 1].

    Parameters
    ----------
    scene: the scans.
    edges: at least a chain.
    starts: ``world_from_scan (k, ...)`` to begin at, the likeliest first; the first pose is kept.
    """
    wide, scored = solve_pose_graph(edges, starts[0]), _by_score(edges)
    if not _contradicted(scene, edges, wide[0]):
        return wide
    solutions = [wide] + [solve_pose_graph(scored, one, near=True) for one in starts]
    pairs, weight = _witnesses(scene, edges, [poses for poses, _ in solutions])
    if not len(weight):
        return wide
    agreement = [float(weight @ scores(scene, pairs, poses.between(*pairs))) for poses, _ in solutions]
    return solutions[agreement.index(max(agreement))]


def _contradicted(scene: Scene, edges: Edges, poses: RigidMotion) -> bool:
    """Whether the poses leave a registered edge; where they meet all, there is nothing to doubt."""
    registered = edges.kept(edges.kind != GIVEN)
    motion = poses.between(registered.target, registered.source)
    away = apart(scene, registered.source, motion, registered.target_from_source)
    return bool((away > ALIKE * scene.spacing).any())


def _by_score(edges: Edges) -> Edges:
    """The edges, each as strong as the square of its score over the median; given motions as they are.

    Where most scores are 0, nothing fits, the median is of the others.
    """
    registered = edges.kind != GIVEN
    scores = edges.score[registered]
    if (scores > 0).any() and scores.median() == 0:
        scores = scores[scores > 0]
    share = (edges.score / scores.median().clamp(min=1e-300)).clamp(min=FAINTEST)
    strength = torch.where(registered, share, 1.0).square()
    return edges._replace(information=strength[:, None, None] * edges.information)


def _witnesses(
    scene: Scene, edges: Edges, solutions: Sequence[RigidMotion]
) -> tuple[tuple[Tensor, Tensor], Float[Tensor, " w"]]:
    """Pairs of scans that are near each other in a solution, or joined, and not placed alike by all; their weights."""
    registered = edges.kept(edges.kind != GIVEN)
    joined = set(zip(registered.target.tolist(), registered.source.tolist(), strict=True))
    pairs = sorted(joined.union(*(_near(scene, poses) for poses in solutions)))
    target, source = torch.tensor(pairs).unbind(1)
    weight = torch.tensor([JOINED if pair in joined else 1.0 for pair in pairs], dtype=torch.float64)
    motions = [poses.between(target, source) for poses in solutions]
    away = torch.stack([apart(scene, source, motion, motions[0]) for motion in motions[1:]]).amax(0)
    differ = torch.nonzero(away > ALIKE * scene.spacing)[:, 0]
    some = differ[torch.linspace(0, len(differ) - 1, min(len(differ), MOST)).round().long()]
    return (target[some], source[some]), weight[some]


def _near(scene: Scene, poses: RigidMotion) -> set[tuple[int, int]]:
    """Each scan with the scans nearest to it, the earlier one first."""
    places = poses.translation.numpy()
    close, partner = cKDTree(places).query(places, k=NEAREST + 1, distance_upper_bound=reach(scene))
    first, rank = np.nonzero(np.isfinite(close))
    pairs = np.sort(np.stack((first, partner[first, rank]), 1), axis=1)
    return {(int(i), int(j)) for i, j in pairs if i != j}  # each scan is among its own nearest
