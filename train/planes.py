"""Planes through the points of many scans, and the step of all poses that brings the points nearer to them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import bsr_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import spsolve

from train.refinement import jacobian

# Fits of each plane: all but the first without what lies far off.
FITS = 3
# Added to the diagonal of the normal equations, as a share of it; and to a plane's own where its points are one.
DAMPING, TINY = 1e-6, 1e-300


class Placed(NamedTuple):
    """Points and unit normals ``(n, d)``, and the number of the scan that each is of, ``(n,)``."""

    points: Float[np.ndarray, "n d"]
    normals: Float[np.ndarray, "n d"]
    owner: Int[np.ndarray, " n"]

    def at(self, world_from_scan: Float[np.ndarray, "k d1 d1"]) -> "Placed":
        """In the world, each point by the pose of its scan."""
        pose = world_from_scan[self.owner]
        points, normals = (np.einsum("nab,nb->na", pose[:, :-1, :-1], x) for x in (self.points, self.normals))
        return Placed(points + pose[:, :-1, -1], normals, self.owner)


class Planes(NamedTuple):
    """c planes and the points near them, pair by pair.

    ``plane``, ``point (p,)``: numbers of each pair. ``weight (p,)``. ``offset (p, d)``: of the point from the plane's
    centre along its axes, the normal first. ``axes (c, d, d)``: in columns.
    """

    plane: Int[np.ndarray, " p"]
    point: Int[np.ndarray, " p"]
    weight: Float[np.ndarray, " p"]
    offset: Float[np.ndarray, "p d"]
    axes: Float[np.ndarray, "c d d"]


def fitted(
    plane: Int[np.ndarray, " p"],
    point: Int[np.ndarray, " p"],
    offsets: Float[np.ndarray, "p d"],
    belief: Float[np.ndarray, " p"],
    width: float | None,
) -> Planes:
    """The plane through the points of each number; without a ``width`` nothing counts as an outlier."""
    count, d, weight = int(plane.max(initial=-1)) + 1, offsets.shape[1], belief

    def summed(values: np.ndarray) -> np.ndarray:
        return np.bincount(plane, values, minlength=count)

    for _ in range(FITS if width else 1):
        total = np.maximum(summed(weight), np.finfo(float).tiny)
        centre = np.stack([summed(weight * offsets[:, a]) for a in range(d)], axis=1) / total[:, None]
        apart = offsets - centre[plane]
        entries = [summed(weight * apart[:, a] * apart[:, b]) / total for a in range(d) for b in range(d)]
        axes = np.linalg.eigh(np.stack(entries, axis=1).reshape(count, d, d))[1]
        along = np.einsum("pa,pab->pb", apart, axes[plane])
        if width:
            weight = belief / (1 + (along[:, 0] / width) ** 2) ** 2
    return Planes(plane, point, weight, along, axes)


def thinning_step(planes: Planes, here: Placed, poses: Float[np.ndarray, "k d1 d1"]) -> Float[np.ndarray, "k size"]:
    """Turn and shift of every pose that thin the surfaces most, each plane free to follow its points."""
    owner, normal = here.owner[planes.point], planes.axes[planes.plane][:, :, 0]
    turns = jacobian(here.points[planes.point] - poses[owner][:, :-1, -1], normal)
    pairs, size = turns.shape
    d, count = poses.shape[1] - 1, len(planes.axes)
    # Each point lies near about as many planes as a plane has points: all points together then count alike.
    weight = planes.weight / np.bincount(planes.plane)[planes.plane]
    rows = np.repeat(np.arange(pairs), size)
    columns = (owner[:, None] * size + np.arange(size)).ravel()
    poses_move = csr_array((turns.ravel(), (rows, columns)), shape=(pairs, len(poses) * size))
    # Height and slopes of the plane itself: what the points do together is no thickness.
    follows = np.column_stack((np.ones(pairs), planes.offset[:, 1:]))
    rows, columns = np.repeat(np.arange(pairs), d), (planes.plane[:, None] * d + np.arange(d)).ravel()
    planes_move = csr_array((follows.ravel(), (rows, columns)), shape=(pairs, count * d))
    weighted = diags_array(weight) @ poses_move
    crossed = (planes_move.T @ weighted).tocsr()
    own = _blocks(planes.plane, follows * weight[:, None], follows)
    own += np.finfo(float).eps * np.trace(own, axis1=1, axis2=2)[:, None, None] * np.eye(d) + TINY * np.eye(d)
    inverse = bsr_array((np.linalg.inv(own), np.arange(count), np.arange(count + 1)))
    alone = poses_move.T @ weighted
    hessian = (alone - crossed.T @ (inverse @ crossed)).tocsc()[size:, size:]
    # The planes were fitted with the weights before the last: what they would still follow is no force on the poses.
    height = planes.offset[:, 0]
    force = (weighted.T @ height - crossed.T @ (inverse @ (planes_move.T @ (weight * height))))[size:]
    # Of the poses alone: a scan that shares no plane keeps nothing but rounding of its own share.
    diagonal = alone.diagonal()[size:]
    step = spsolve(csc_array(hessian + diags_array(DAMPING * diagonal + (diagonal == 0))), -force)
    return np.concatenate((np.zeros(size), step)).reshape(len(poses), size)


def _blocks(group: Int[np.ndarray, " p"], left: np.ndarray, right: np.ndarray) -> Float[np.ndarray, "c d d"]:
    """Sum of the outer products of the rows of each group."""
    d = left.shape[1]
    entries = [np.bincount(group, left[:, a] * right[:, b]) for a in range(d) for b in range(d)]
    return np.stack(entries, axis=1).reshape(-1, d, d)
