"""F on its mutual pairs, compiled: the slope of the loss by the pose, and the adjoint of that; see ``matched.py``."""

from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_math import compiled
from bbr_layer.kernels.cpu_turns import apply, cross
from bbr_layer.pair import CloudPair
from bbr_layer.trees import in_space

# Directions of a further turn and shift of the pose.
TANGENT = 6


class MatchedClouds(NamedTuple):
    """One item in space, float64: points and normals ``(n, 3)`` or ``(m, 3)``, weights ``(n,)`` or ``(m,)``."""

    P: np.ndarray
    Q: np.ndarray
    P_normals: np.ndarray
    Q_normals: np.ndarray
    P_weights: np.ndarray
    Q_weights: np.ndarray


def matched_clouds(pair: CloudPair) -> list[MatchedClouds]:
    """Each item of a pair with normals; of the plane, embedded in space."""
    vectors = (pair.P, pair.Q, *pair.both_normals())
    tables = [in_space(x.detach().double().numpy()) for x in vectors]
    for points, weights in ((pair.P, pair.P_weights), (pair.Q, pair.Q_weights)):
        tables.append(np.ones(points.shape[:2]) if weights is None else weights.detach().double().numpy())
    return [MatchedClouds(*map(np.ascontiguousarray, item)) for item in zip(*tables, strict=True)]


@compiled()
def _scale(clouds, index, mutual):  # type: ignore[no-untyped-def]
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
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def _combined(s, a, t, b):  # type: ignore[no-untyped-def]
    """``s a + t b``."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@compiled()
def _place(clouds, i, j, pose):  # type: ignore[no-untyped-def]
    """A pair in the target's frame: arm, turned normal, offset from P to the moved Q, n_q + s n_p, and s."""
    rotation, shift = pose
    arm, turned = _carry(rotation, clouds.Q, j), _carry(rotation, clouds.Q_normals, j)
    facing = clouds.P_normals[i, 0], clouds.P_normals[i, 1], clouds.P_normals[i, 2]
    sign = -1.0 if _dot(facing, turned) < 0 else 1.0
    offset = arm[0] + shift[0] - clouds.P[i, 0], arm[1] + shift[1] - clouds.P[i, 1], arm[2] + shift[2] - clouds.P[i, 2]
    return arm, turned, offset, _combined(1.0, turned, sign, facing), sign


@compiled()
def _pull(clouds, pairs, j, placing):  # type: ignore[no-untyped-def]
    """How much a pair pulls per unit of its residual, the residual, and its derivative by a turn and by a shift.

    ``placing`` is (pose, temperature, one over the weight of all pairs).
    """
    (index, _), (pose, temperature, scale) = pairs, placing
    arm, turned, offset, plane, _ = _place(clouds, index[j], j, pose)
    residual = _dot(offset, plane)
    squared = residual * residual + temperature * temperature
    weight = scale * clouds.P_weights[index[j]] * clouds.Q_weights[j]
    torque = _combined(1.0, cross(arm, plane), 1.0, cross(turned, offset))
    return weight / (np.sqrt(squared) if squared > 0 else 1.0), residual, torque, plane


@compiled()
def slope_of(clouds, pairs, pose, temperature):  # type: ignore[no-untyped-def]
    """The mean rounded distance's gradient by a turn and shift, ``(6,)``; ``pairs`` is (index, mutual)."""
    index, mutual = pairs
    slope, placing = np.zeros(TANGENT), (pose, temperature, _scale(clouds, index, mutual))
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
    placing = pose, temperature, _scale(clouds, index, mutual)
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


@compiled()
def _rates(placed, weight, temperature, along):  # type: ignore[no-untyped-def]
    """How a pair's force and torque change along ``(turn, shift)``: their cotangents in the source's turned frame.

    Answers with pull and twist, the plain rates of force and torque, the rate of the distance and of the loss by
    temperature.
    """
    arm, turned, offset, plane, _ = placed
    turn, shift = along
    velocity, spin = _combined(1.0, cross(turn, arm), 1.0, shift), cross(turn, turned)
    residual = _dot(offset, plane)
    residual_rate = _dot(velocity, plane) + _dot(offset, spin)
    squared = residual * residual + temperature * temperature
    inverse = 1 / np.sqrt(squared) if squared > 0 else 0.0
    rate = residual * residual_rate * inverse
    over = weight * inverse
    over_rate = -over * rate * inverse
    push, push_rate = over * residual, over_rate * residual + over * residual_rate
    force_rate, torque_rate = _combined(push_rate, plane, push, spin), _combined(push_rate, offset, push, velocity)
    pull = _combined(1.0, force_rate, -push, cross(turn, plane))
    twist = _combined(1.0, torque_rate, -push, cross(turn, offset))
    return pull, twist, force_rate, torque_rate, rate, temperature * over_rate


@compiled()
def add_adjoint(clouds, pairs, pose, heated, out):  # type: ignore[no-untyped-def]
    """Adjoint of ``along . slope``, ``heated`` being (temperature, along); its derivative by the temperature.

    Added into ``out``: by rotation ``(3, 3)``, translation, and P, Q and their normals ``(3, points)``. The rates of
    the distances ``(m,)`` come back too: the weights' adjoint follows from them.
    """
    (index, mutual), (temperature, direction) = pairs, heated
    by_rotation, by_translation, by_P, by_Q, by_P_normals, by_Q_normals = out
    along = (direction[0], direction[1], direction[2]), (direction[3], direction[4], direction[5])
    rotation, scale, heat, rates = pose[0], _scale(clouds, index, mutual), 0.0, np.zeros(len(index))
    for j in range(len(index)):
        if not mutual[j]:
            continue
        i = index[j]
        placed = _place(clouds, i, j, pose)
        weight = scale * clouds.P_weights[i] * clouds.Q_weights[j]
        pull, twist, force_rate, torque_rate, rates[j], warming = _rates(placed, weight, temperature, along)
        heat += warming
        for k in range(3):
            by_translation[k] += force_rate[k]
            by_P[k, i] -= force_rate[k]
            by_P_normals[k, i] += placed[4] * torque_rate[k]
            for axis in range(3):
                by_rotation[k, axis] += pull[k] * clouds.Q[j, axis] + twist[k] * clouds.Q_normals[j, axis]
                by_Q[axis, j] += pull[k] * rotation[k, axis]
                by_Q_normals[axis, j] += twist[k] * rotation[k, axis]
    return heat, rates


@compiled()
def add_weights(clouds, pairs, rates, by_P_weights, by_Q_weights):  # type: ignore[no-untyped-def]
    """The adjoint of the weights: a pair counts by how much faster than the mean its distance changes."""
    index, mutual = pairs
    scale, mean = _scale(clouds, index, mutual), 0.0
    for j in range(len(index)):
        if mutual[j]:
            mean += scale * clouds.P_weights[index[j]] * clouds.Q_weights[j] * rates[j]
    for j in range(len(index)):
        if mutual[j]:
            i = index[j]
            by_P_weights[i] += (rates[j] - mean) * clouds.Q_weights[j] * scale
            by_Q_weights[j] += (rates[j] - mean) * clouds.P_weights[i] * scale
