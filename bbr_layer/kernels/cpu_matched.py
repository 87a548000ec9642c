"""F on its mutual pairs, compiled: the slope of the loss by the pose, and normal equations; see ``matched.py``."""

from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_turns import apply, cross
from bbr_layer.kernels.likeness import NORMALS_APART, POINTS_APART
from bbr_layer.pair import CloudPair
from bbr_layer.trees import in_space

# Directions of a further turn and shift of the pose.
TANGENT = 6


class MatchedClouds(NamedTuple):
    """One item in space, float64: points and normals ``(n, 3)`` or ``(m, 3)``, weights ``(n,)`` or ``(m,)``.

    ``flat`` is one over the reach of the loss, 0 where that is infinite. ``near`` is one over the square of the
    distance at which two points count half in normal equations, 0 where all pairs count alike.
    """

    P: np.ndarray
    Q: np.ndarray
    P_normals: np.ndarray
    Q_normals: np.ndarray
    P_weights: np.ndarray
    Q_weights: np.ndarray
    flat: float
    near: float


def matched_clouds(pair: CloudPair, reach: float, alike: bool = False) -> list[MatchedClouds]:
    """Each item of a pair with normals; of the plane, embedded in space. ``reach``, ``alike``: see ``BuddyFilter``."""
    vectors = (pair.P, pair.Q, *pair.both_normals())
    tables = [in_space(x.detach().double().numpy()) for x in vectors]
    for points, weights in ((pair.P, pair.P_weights), (pair.Q, pair.Q_weights)):
        tables.append(np.ones(points.shape[:2]) if weights is None else weights.detach().double().numpy())
    tables.append(np.zeros(len(pair.P)))
    if alike:
        tables[-1] = (POINTS_APART * pair.known_spacing().detach().double().numpy()) ** -2
    items = zip(*(np.ascontiguousarray(table) for table in tables), strict=True)
    return [MatchedClouds._make((*item[:-1], 1 / reach, float(item[-1]))) for item in items]


@compiled()
def scale_of(clouds, index, mutual):  # type: ignore[no-untyped-def]
    """One over the weight of all mutual pairs; 0 without any."""
    total = 0.0
    for j in range(len(index)):
        if mutual[j]:
            total += clouds.P_weights[index[j]] * clouds.Q_weights[j]
    return 1 / total if total > 0 else 0.0


@compiled()
def _carry(matrix, table, row):  # type: ignore[no-untyped-def]
    return apply(matrix, (table[row, 0], table[row, 1], table[row, 2]))


@compiled()
def dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def combined(s, a, t, b):  # type: ignore[no-untyped-def]
    """``s a + t b``."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@compiled()
def place_of(clouds, i, j, pose):  # type: ignore[no-untyped-def]
    """A pair in the target's frame: arm, turned normal, offset from P to the moved Q, n_q + s n_p, and s."""
    rotation, shift = pose
    arm, turned = _carry(rotation, clouds.Q, j), _carry(rotation, clouds.Q_normals, j)
    facing = clouds.P_normals[i, 0], clouds.P_normals[i, 1], clouds.P_normals[i, 2]
    sign = -1.0 if dot(facing, turned) < 0 else 1.0
    offset = arm[0] + shift[0] - clouds.P[i, 0], arm[1] + shift[1] - clouds.P[i, 1], arm[2] + shift[2] - clouds.P[i, 2]
    return arm, turned, offset, combined(1.0, turned, sign, facing), sign


@compiled()
def steepness_of(flat, temperature, rounded):  # type: ignore[no-untyped-def]
    """``u = 1 / (1 + d / (reach * temperature))``: a rounded distance d counts as d u, and its slope is u squared."""
    return 1 / (1 + rounded * flat / temperature) if flat > 0 else 1.0


@compiled()
def _likeness(near, offset, normals):  # type: ignore[no-untyped-def]
    """As ``likeness.likeness``; 1 where all pairs count alike."""
    if near == 0:
        return 1.0
    return NORMALS_APART / ((1 + near * dot(offset, offset)) * (1 - abs(dot(normals[0], normals[1])) + NORMALS_APART))


@compiled()
def pull_of(clouds, placed, temperature):  # type: ignore[no-untyped-def]
    """How much a pair of weight 1 pulls per unit of its residual, the residual, one over its rounded distance, and u.

    A distance of 0, which only a temperature of 0 leaves, does not pull, and its inverse is 0. ``u``: see
    ``steepness_of``.
    """
    _, turned, offset, plane, sign = placed
    residual = dot(offset, plane)
    squared = residual * residual + temperature * temperature
    inverse = 1 / np.sqrt(squared) if squared > 0 else 0.0
    steepness = steepness_of(clouds.flat, temperature, np.sqrt(squared))
    facing = combined(sign, plane, -sign, turned)
    return (
        _likeness(clouds.near, offset, (facing, turned)) * steepness * steepness * inverse,
        residual,
        inverse,
        steepness,
    )


@compiled()
def torque_of(placed):  # type: ignore[no-untyped-def]
    """The derivative of a pair's residual by a turn; by a shift it is the plane."""
    arm, turned, offset, plane, _ = placed
    return combined(1.0, cross(arm, plane), 1.0, cross(turned, offset))


@compiled()
def _pull(clouds, pairs, j, placing):  # type: ignore[no-untyped-def]
    """How much a pair pulls per unit of its residual, the residual, and its derivative by a turn and by a shift.

    ``placing`` is (pose, temperature, one over the weight of all pairs).
    """
    (index, _), (pose, temperature, scale) = pairs, placing
    placed = place_of(clouds, index[j], j, pose)
    pull, residual, _, _ = pull_of(clouds, placed, temperature)
    return scale * clouds.P_weights[index[j]] * clouds.Q_weights[j] * pull, residual, torque_of(placed), placed[3]


@compiled()
def slope_of(clouds, pairs, pose, temperature):  # type: ignore[no-untyped-def]
    """The mean rounded distance's gradient by a turn and shift, ``(6,)``; ``pairs`` is (index, mutual)."""
    index, mutual = pairs
    slope, placing = np.zeros(TANGENT), (pose, temperature, scale_of(clouds, index, mutual))
    for j in range(len(index)):
        if mutual[j]:
            pull, residual, torque, plane = _pull(clouds, pairs, j, placing)
            for k in range(3):
                slope[k] += pull * residual * torque[k]
                slope[3 + k] += pull * residual * plane[k]
    return slope


@compiled()
def equations_of(clouds, pairs, pose, temperature):  # type: ignore[no-untyped-def]
    """Normal equations of a Gauss-Newton step, ``(6, 6)`` and ``(6,)``; see ``MatchedSquares``."""
    index, mutual = pairs
    matrix, slope, row = np.zeros((TANGENT, TANGENT)), np.zeros(TANGENT), np.empty(TANGENT)
    placing = pose, temperature, scale_of(clouds, index, mutual)
    for j in range(len(index)):
        if not mutual[j]:
            continue
        pull, residual, torque, plane = _pull(clouds, pairs, j, placing)
        for k in range(3):
            row[k], row[3 + k] = torque[k], plane[k]
        for k in range(TANGENT):
            slope[k] += pull * residual * row[k]
            for other in range(k + 1):
                matrix[k, other] += pull * row[k] * row[other]
    for k in range(TANGENT):
        for other in range(k):
            matrix[other, k] = matrix[k, other]
    return matrix, slope
