"""A careful point-to-line ICP in the plane, chained, and with a window, loops and a robust pose graph.

Censi, An ICP variant using a point-to-line metric, ICRA 2008: here with a gate that shrinks from step to step, a Huber
kernel on the median residual, and no lines where neighbours do not lie on one.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree

from bbr_layer import RigidMotion
from benchmarks.map_rivals.chain import (
    GRAPH,
    GRAPH_YAW,
    PLAIN,
    YAW,
    Overlap,
    Solutions,
    along,
    chained,
    from_turned_starts,
    in_own_unit,
    in_reaches,
    loop_pairs,
    reach,
    window_pairs,
)
from train.pose_graph import Edges, solve_pose_graph
from train.scans import Progress, ScanSet

# The narrowest gate, reaches; the factor of one step, and at most so many more steps at the narrowest.
NARROW, SHRINKING, MORE = 0.03, 0.9, 30
# Where pairs begin that are started from poses, reaches.
FROM_POSES = 0.15
# Points of a line, and how thick it may be beside its length, root mean square.
NEIGHBOURS, THICK = 5, 0.1
# Huber's width in standard deviations, and a standard deviation of a Gaussian in median residuals.
HUBER, DEVIATION = 1.345, 1.4826
# A step that counts as none, radians and reaches; the least residual scale, reaches.
TIGHT, FLOOR = 1e-7, 1e-9
# Loops count from this part of the chain's median overlap; rounds of seeking them.
LOOP_SHARE, ROUNDS = 0.8, 2


class Lines(NamedTuple):
    """Points ``(n, 2)`` in reaches, their lines' normals, and which of them lie on a line."""

    points: np.ndarray
    normals: np.ndarray
    straight: np.ndarray
    tree: KDTree


def lines(points: np.ndarray) -> Lines:
    """A line through the neighbours of every point."""
    tree = KDTree(points)
    near = points[tree.query(points, min(NEIGHBOURS, len(points)))[1]]
    spread = near - near.mean(axis=1, keepdims=True)
    sizes, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))
    straight = sizes[:, 0] <= THICK**2 * sizes[:, 1]
    return Lines(points, axes[:, :, 0], straight, tree)


def point_to_line(target: Lines, source: Lines, start: np.ndarray, widest: float) -> tuple[np.ndarray, np.ndarray]:
    """``target_from_source (3, 3)``, and its information ``(3, 3)`` per pair about the source's centroid."""
    motion, information = start, np.eye(3)
    steps = int(np.log(NARROW / widest) / np.log(SHRINKING))
    for gate in [*widest * SHRINKING ** np.arange(steps), *[NARROW] * MORE]:
        moved = source.points @ motion[:2, :2].T + motion[:2, 2]
        found, near = target.tree.query(moved, distance_upper_bound=gate)
        met = np.isfinite(found)
        met[met] = target.straight[near[met]]
        if met.sum() < 3:
            continue
        normals, centre = target.normals[near[met]], moved.mean(axis=0)
        residual = ((moved[met] - target.points[near[met]]) * normals).sum(axis=1)
        arm = moved[met] - centre
        jacobian = np.column_stack((normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1], normals))
        weight = huber(residual)
        information = (jacobian * weight[:, None]).T @ jacobian / weight.sum()
        step = -np.linalg.pinv(information, rcond=1e-9) @ (jacobian * weight[:, None]).T @ residual / weight.sum()
        motion = _about(centre, step) @ motion
        if gate == NARROW and np.abs(step).max() < TIGHT:
            break
    return motion, information


def huber(residual: np.ndarray) -> np.ndarray:
    """Weights of Huber's kernel, its width from the median residual."""
    width = HUBER * max(DEVIATION * float(np.median(np.abs(residual))), FLOOR)
    return width / np.maximum(np.abs(residual), width)


def _about(centre: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A turn about ``centre`` by ``step[0]`` radians and a shift by the rest, ``(3, 3)``."""
    cosine, sine = np.cos(step[0]), np.sin(step[0])
    motion = np.eye(3)
    motion[:2, :2] = [[cosine, -sine], [sine, cosine]]
    motion[:2, 2] = centre - motion[:2, :2] @ centre + step[1:]
    return motion


class PointToLine:
    """Pairs of planar scans; the widest gate in reaches."""

    def __init__(self, scans: ScanSet, widest: float) -> None:
        self.points, self.tolerance, self.widest = in_reaches(scans), NARROW, widest
        self.lines = [lines(points) for points in self.points]

    def register(self, target: int, source: int, start: np.ndarray) -> np.ndarray:
        """``target_from_source (3, 3)``."""
        return point_to_line(self.lines[target], self.lines[source], start, self.widest)[0]

    def edges(self, pairs: list[tuple[int, int]], starts: list[np.ndarray], widest: float, overlap: Overlap) -> Edges:
        """The pairs registered, as edges of a pose graph in reaches."""
        found = [
            point_to_line(self.lines[i], self.lines[j], start, widest)
            for (i, j), start in zip(pairs, starts, strict=True)
        ]
        motions, information = (torch.from_numpy(np.stack(part)) for part in zip(*found, strict=True))
        target, source = torch.tensor(pairs).unbind(1)
        centre = torch.from_numpy(np.stack([self.points[j].mean(axis=0) for _, j in pairs]))
        score = torch.tensor(
            [overlap(i, j, motion) for (i, j), motion in zip(pairs, motions.numpy(), strict=True)],
            dtype=torch.float64,
        )
        return Edges(
            target, source, RigidMotion.from_matrix(motions), information, centre, score, torch.zeros_like(target)
        )


def solved(scans: ScanSet, setting: tuple[float, bool], told: Progress) -> Solutions:
    """Poses ``(k, 3, 3)`` along the chain, and those that it, a window and loops agree on.

    ``setting``: the widest gate, and whether to begin at the last motion.
    """
    rival, unit = PointToLine(scans, setting[0]), reach(scans)
    motions = chained(rival, 3, setting[1], told)
    yield PLAIN, in_own_unit(along(motions), unit)
    graph = agreed(rival, motions, told)
    yield GRAPH, in_own_unit(graph, unit)
    found = from_turned_starts(rival, motions, told)
    yield YAW, in_own_unit(along(found), unit)
    yield GRAPH_YAW, in_own_unit(graph if np.array_equal(found, motions) else agreed(rival, found, told), unit)


def agreed(rival: PointToLine, motions: np.ndarray, told: Progress) -> np.ndarray:
    """Poses ``(k, 3, 3)`` in reaches of a robust pose graph."""
    return agreed_edges(rival, motions, told)[1]


def agreed_edges(rival: PointToLine, motions: np.ndarray, told: Progress) -> tuple[Edges, np.ndarray]:
    """Chain, window and loops, and the poses ``(k, 3, 3)`` that they agree on; in reaches."""
    overlap, count = Overlap(rival.points, rival.tolerance), len(motions) + 1
    edges = rival.edges([(i, i + 1) for i in range(count - 1)], list(motions), FROM_POSES, overlap)
    least, poses = LOOP_SHARE * edges.score.median(), along(edges.target_from_source.matrix.numpy())
    if count > 2:
        edges = edges.joined(_from(rival, window_pairs(count), poses, overlap, kind=1))
    poses = _solved_graph(edges, poses)
    for turn in range(ROUNDS):
        told("rounds of loops", turn + 1, ROUNDS)
        joined = set(zip(edges.target.tolist(), edges.source.tolist(), strict=True))
        pairs = [pair for pair in loop_pairs(poses) if pair not in joined]
        if not pairs:
            break
        loops = _from(rival, pairs, poses, overlap, kind=2)
        edges = edges.joined(loops.kept(loops.score >= least))
        poses = _solved_graph(edges, poses)
    return edges, poses


def _from(rival: PointToLine, pairs: list[tuple[int, int]], poses: np.ndarray, overlap: Overlap, *, kind: int) -> Edges:
    starts = [np.linalg.inv(poses[i]) @ poses[j] for i, j in pairs]
    found = rival.edges(pairs, starts, FROM_POSES, overlap)
    return found._replace(kind=torch.full_like(found.kind, kind))


def _solved_graph(edges: Edges, poses: np.ndarray) -> np.ndarray:
    return solve_pose_graph(edges, motions_of(poses))[0].matrix.numpy()


def motions_of(poses: np.ndarray) -> RigidMotion:
    """Poses ``(k, 3, 3)`` as motions."""
    return RigidMotion.from_matrix(torch.from_numpy(poses))
