"""All poses at once from all points: F's pairs (Eq. 8 of the paper) between the scans of every edge, by Gauss-Newton.

A pose graph weighs what each edge found alone; here the pairs themselves pull, found anew at every step from the
poses of all scans, and a pair far off its plane loses its weight (Geman-McClure) whatever edge it belongs to.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from train.scans import Progress, silent
from train.surfaces import Surface

# Most steps; the width of the kernel settles within about 8.
STEPS = 15
# Width of the kernel: at first in point spacings, then in medians of the distances to the planes, never below a share
# of the spacing; and the width for the distance between the two points of a pair, in spacings. In space the median is
# that of the ground, and what lies rougher holds along the street: 15 against 4.5 bring kitti00 and kitti07 nearer.
FIRST_WIDTH, FINAL_WIDTH, FINEST_WIDTH, APART = 1.0, {2: 4.5, 3: 15.0}, 1e-3, 8.0
# The kernel narrows by this factor a step at most.
NARROWING = 0.5
# Done when nothing moved by more than this share of a point spacing.
SETTLED = 1e-5
# Added to the diagonal of the normal equations, as a share of it: a scan that no pair holds stays.
DAMPING = 1e-9


class Pairs(NamedTuple):
    """Mutual pairs of one edge: moved points and planes in the world, ``(n, d)`` each, and their point numbers."""

    target: Float[np.ndarray, "n d"]
    source: Float[np.ndarray, "n d"]
    plane: Float[np.ndarray, "n d"]
    target_index: Int[np.ndarray, " n"]
    source_index: Int[np.ndarray, " n"]


def refine(
    scans: Sequence[Surface],
    edges: Int[np.ndarray, "e 2"],
    world_from_scan: Float[np.ndarray, "k d1 d1"],
    weights: tuple[Float[np.ndarray, " e"], Sequence[Float[np.ndarray, " _"]]],
    progress: Progress = silent,
) -> Float[np.ndarray, "k d1 d1"]:
    """Poses ``(k, d + 1, d + 1)`` at which the mutual pairs of all edges agree; the first pose is kept.

    Where no edge has weight all are kept.

    Parameters
    ----------
    scans: the k scans.
    edges: target and source of each.
    world_from_scan: poses to begin at, within about a spacing where many pairs are to be right.
    weights: of the edges, and of the points of each scan; not negative.
    progress: told each step.
    """
    poses, width = world_from_scan.copy(), FIRST_WIDTH
    radii = np.array([scan.radius for scan in scans])
    spacing = min(scan.spacing for scan in scans)
    d = poses.shape[1] - 1
    used = weights[0] > 0
    if not used.any():
        return poses
    edges, trust = edges[used], weights[0][used]
    for step in range(STEPS):
        progress("refinement", step, STEPS)
        found = [mutual_pairs(scans, edge, poses) for edge in edges]
        moves, median = _gauss_newton(scans, (edges, found), poses, (trust, weights[1], width))
        poses = moved(poses, moves)
        turned, shifted = (np.linalg.norm(part, axis=1) for part in (moves[:, :-d], moves[:, -d:]))
        settled = np.max(turned * radii + shifted) < SETTLED * spacing
        final = max(FINAL_WIDTH[d] * median, FINEST_WIDTH)
        if settled and width <= final:
            break
        width = min(width, max(final, NARROWING * width))
    progress("refinement", STEPS, STEPS)
    return poses


def mutual_pairs(scans: Sequence[Surface], edge: Int[np.ndarray, "2"], poses: Float[np.ndarray, "k d1 d1"]) -> Pairs:
    """Points of the two scans of an edge that are each other's nearest, with the plane between them (Eq. 7)."""
    target, source = (scans[number] for number in edge)
    to_world, from_source = (poses[number] for number in edge)
    relative = np.linalg.inv(to_world) @ from_source
    rotation, shift = relative[:-1, :-1], relative[:-1, -1]
    nearest = target.tree.query(source.points @ rotation.T + shift)[1]
    back = source.tree.query((target.points - shift) @ rotation)[1]
    mine = np.flatnonzero(back[nearest] == np.arange(len(nearest)))
    theirs = nearest[mine]
    normals = source.normals[mine] @ rotation.T
    signs = np.where((normals * target.normals[theirs]).sum(axis=1) < 0, -1.0, 1.0)
    planes = (target.normals[theirs] + signs[:, None] * normals) / 2
    placed = [
        cloud @ pose[:-1, :-1].T + pose[:-1, -1]
        for cloud, pose in ((target.points[theirs], to_world), (source.points[mine], from_source))
    ]
    return Pairs(placed[0], placed[1], planes @ to_world[:-1, :-1].T, theirs, mine)


def _gauss_newton(
    scans: Sequence[Surface],
    graph: tuple[Int[np.ndarray, "e 2"], list[Pairs]],
    poses: Float[np.ndarray, "k d1 d1"],
    weights: tuple[np.ndarray, Sequence[np.ndarray], float],
) -> tuple[Float[np.ndarray, "k size"], float]:
    """One step for all poses, turn about the scan's own place before shift; and the median distance in spacings."""
    edges, found = graph
    trust, of_points, width = weights
    size = poses.shape[1] * (poses.shape[1] - 1) // 2
    blocks, forces, distances = [], np.zeros((len(poses), size)), []
    for (target, source), pairs, belief in zip(edges, found, trust, strict=True):
        spacing = max(scans[target].spacing, scans[source].spacing)
        offset = pairs.source - pairs.target
        off_plane = (offset * pairs.plane).sum(axis=1)
        apart = (offset**2).sum(axis=1) / (APART * spacing) ** 2
        weight = belief / ((1 + (off_plane / (width * spacing)) ** 2) * (1 + apart)) ** 2
        weight = weight * of_points[target][pairs.target_index] * of_points[source][pairs.source_index]
        # one arm for both scans: the plane turns with them, so that a turn of the two together changes nothing
        middle = (pairs.target + pairs.source) / 2
        levers = [middle - poses[number, :-1, -1] for number in (target, source)]
        both = np.concatenate((-jacobian(levers[0], pairs.plane), jacobian(levers[1], pairs.plane)), axis=1)
        weighted = both * weight[:, None]
        blocks.append(weighted.T @ both)
        pull = weighted.T @ off_plane
        forces[target] += pull[:size]
        forces[source] += pull[size:]
        distances.append(np.abs(off_plane[apart < 1]) / spacing)
    return _solved(edges, np.array(blocks), forces), float(np.median(np.concatenate(distances)))


def jacobian(arms: Float[np.ndarray, "n d"], planes: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n size"]:
    """d(plane . moved point) / d(turn, shift)."""
    turn = np.cross(arms, planes) if arms.shape[1] == 3 else arms[:, 0] * planes[:, 1] - arms[:, 1] * planes[:, 0]
    return np.column_stack((turn, planes))


def _solved(
    edges: Int[np.ndarray, "e 2"], blocks: Float[np.ndarray, "e two two"], forces: Float[np.ndarray, "k size"]
) -> Float[np.ndarray, "k size"]:
    k, size = forces.shape
    rows = (edges[:, :, None] * size + np.arange(size)).reshape(len(edges), -1)
    places = (np.repeat(rows, 2 * size, axis=1).ravel(), np.tile(rows, (1, 2 * size)).ravel())
    hessian = csc_array(coo_array((blocks.ravel(), places), shape=(k * size, k * size)))[size:, size:]
    diagonal = hessian.diagonal()
    damping = np.where(diagonal > 0, DAMPING * diagonal, 1.0)
    hessian = hessian + csc_array(coo_array((damping, (np.arange(len(damping)),) * 2)))
    step = spsolve(csc_array(hessian), -forces.ravel()[size:])
    return np.concatenate((np.zeros(size), step)).reshape(k, size)


def moved(poses: Float[np.ndarray, "k d1 d1"], moves: Float[np.ndarray, "k size"]) -> Float[np.ndarray, "k d1 d1"]:
    """The poses, all but the first turned about their own places and shifted by ``moves``, turn before shift."""
    d = poses.shape[1] - 1
    turns = np.zeros((len(poses), 3))
    turns[:, 3 - (moves.shape[1] - d) :] = moves[:, :-d]  # in the plane a turn about z
    found = poses.copy()
    found[1:, :d, :d] = Rotation.from_rotvec(turns[1:]).as_matrix()[:, :d, :d] @ poses[1:, :d, :d]
    found[:, :d, d] += moves[:, -d:]
    return found
