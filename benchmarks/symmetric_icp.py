"""Symmetric ICP in numpy: S. Rusinkiewicz, A symmetric objective function for ICP, ACM Transactions on Graphics 2019.

A peer of the benchmarks, not part of the library.
"""

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

STEPS = 100
SETTLED = 1e-7  # radians, and spacings: a smaller step ends the search
DEVIATION = 1.4826  # standard deviations of a normal distribution in one median of absolute values


def symmetric_icp(
    target: np.ndarray,
    source: np.ndarray,
    normals: tuple[np.ndarray, np.ndarray],
    start: np.ndarray,
    reach: float,
) -> np.ndarray:
    """The motion ``(4, 4)`` that carries ``source`` onto ``target``.

    Every step matches each source point with its nearest target point, leaves out pairs farther apart than ``reach``
    robust standard deviations of the distances, and takes the linearised step of the paper's section 3.

    Parameters
    ----------
    target, source: ``(n, 3)`` and ``(m, 3)``.
    normals: of both, unit length; their sides are made to agree pair by pair.
    start: ``(4, 4)``, where to begin.
    reach: standard deviations, the paper's implementation has 2.5.
    """
    tree, motion = KDTree(target), start.copy()
    for _ in range(STEPS):
        moved = source @ motion[:3, :3].T + motion[:3, 3]
        turned = normals[1] @ motion[:3, :3].T
        distance, index = tree.query(moved)
        kept = distance <= reach * DEVIATION * np.median(distance) + np.finfo(float).tiny
        step = symmetric_step(moved[kept], target[index[kept]], turned[kept], normals[0][index[kept]])
        motion = step @ motion
        turn = np.linalg.norm(Rotation.from_matrix(step[:3, :3]).as_rotvec())
        if turn < SETTLED and np.linalg.norm(step[:3] @ np.append(moved.mean(0), 1) - moved.mean(0)) < SETTLED:
            break
    return motion


def symmetric_step(p: np.ndarray, q: np.ndarray, p_normals: np.ndarray, q_normals: np.ndarray) -> np.ndarray:
    """The linearised motion ``(4, 4)`` that lowers the symmetric distances of the pairs ``p`` to ``q``.

    Minimises the sum of ``((p - q) n + ((p + q) x n) a + n t)^2`` with n the sum of both normals and coordinates about
    the centroids; a is the axis times the tangent of half the whole angle (paper, Eq. 9 to 11).
    """
    sides = np.sign(np.einsum("ij,ij->i", p_normals, q_normals))
    n = p_normals * np.where(sides == 0, 1, sides)[:, None] + q_normals
    p_centre, q_centre = p.mean(0), q.mean(0)
    p, q = p - p_centre, q - q_centre
    size = np.sqrt(((p**2).sum() + (q**2).sum()) / (2 * len(p))) or 1.0
    rows = np.column_stack((np.cross(p + q, n) / size, n))
    solved = np.linalg.lstsq(rows, -np.einsum("ij,ij->i", p - q, n), rcond=None)[0]
    axis, way = solved[:3] / size, solved[3:]
    tangent = np.linalg.norm(axis)
    angle = np.arctan(tangent)
    half = Rotation.from_rotvec(axis / tangent * angle if tangent > 0 else axis).as_matrix()
    motion = np.eye(4)
    motion[:3, :3] = half @ half
    motion[:3, 3] = q_centre + half @ (way * np.cos(angle)) - motion[:3, :3] @ p_centre
    return motion
