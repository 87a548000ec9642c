"""The adjoint of a Gauss-Newton step of F by everything, compiled; see ``squares.MatchedSquares``.

A pair with row J (torque, plane), residual r and pull c adds ``c J J^T`` to the matrix and ``c r J`` to the slope. The
step is ``x = -A^-1 slope``, A the matrix damped. With b the cotangent of x and ``z = -A^-1 b`` everything gets the
gradient of ``sum(c ((J z) (J x + r) + s J J))``, where z, x and s are held; s is z x times the damping, over the number
of unknowns.
"""

from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_matched import combined, dot, place_of, pull_of, scale_of, torque_of
from bbr_layer.kernels.cpu_matched_adjoint import add_weights
from bbr_layer.kernels.cpu_turns import cross
from bbr_layer.kernels.likeness import NORMALS_APART


class SquaresAdjoint(NamedTuple):
    """Where cotangents of one item are added up: of the pose, points and normals ``(3, points)``, and weights."""

    rotation: np.ndarray
    translation: np.ndarray
    P: np.ndarray
    Q: np.ndarray
    P_normals: np.ndarray
    Q_normals: np.ndarray
    P_weights: np.ndarray
    Q_weights: np.ndarray


@compiled()
def _by_row(row, residual, along):  # type: ignore[no-untyped-def]
    """A pair's term of the sum per unit of pull, and its gradient by torque, plane and residual."""
    (torque, plane), ((z_turn, z_shift), (x_turn, x_shift), share) = row, along
    ahead = dot(torque, z_turn) + dot(plane, z_shift)
    left = dot(torque, x_turn) + dot(plane, x_shift) + residual
    by_torque = combined(1.0, combined(left, z_turn, ahead, x_turn), 2 * share, torque)
    by_plane = combined(1.0, combined(left, z_shift, ahead, x_shift), 2 * share, plane)
    return ahead * left + share * (dot(torque, torque) + dot(plane, plane)), by_torque, by_plane, ahead


@compiled()
def _by_likeness(near, placed, gain):  # type: ignore[no-untyped-def]
    """The gradient of ``gain`` log(likeness): by offset, turned normal, P's normal and the spacing's logarithm."""
    _, turned, offset, plane, sign = placed
    facing = combined(sign, plane, -sign, turned)
    squared, cosine = near * dot(offset, offset), dot(facing, turned)
    pushed, turning = -2 * gain * near / (1 + squared), 0.0
    if near > 0 and cosine != 0:
        turning = gain * sign / (1 - abs(cosine) + NORMALS_APART)
    return (
        combined(pushed, offset, 0.0, offset),
        combined(turning, facing, 0.0, facing),
        combined(turning, turned, 0.0, turned),
        2 * gain * squared / (1 + squared),
    )


@compiled()
def _cotangents(clouds, placed, weight, temperature, along):  # type: ignore[no-untyped-def]
    """What a pair hands on: by arm, turned normal, P's normal, offset, weight, temperature and spacing's logarithm.

    The arm's has the offset's in it.
    """
    arm, turned, offset, plane, sign = placed
    torque = torque_of(placed)
    unit, residual, inverse, steepness = pull_of(clouds, placed, temperature)
    term, by_torque, by_plane, ahead = _by_row((torque, plane), residual, along)
    pull, gain = weight * unit, weight * unit * term
    steeper = gain * (inverse + (2 * steepness * clouds.flat / temperature if clouds.flat > 0 else 0.0)) * inverse
    warming = -steeper * temperature
    if clouds.flat > 0:
        warming += 2 * gain * (1 - steepness) / temperature
    by_residual = pull * ahead - steeper * residual
    by_torque = combined(pull, by_torque, 0.0, by_torque)
    pushed, turned_to, facing_to, spread = _by_likeness(clouds.near, placed, gain)
    by_offset = combined(1.0, combined(by_residual, plane, 1.0, cross(by_torque, turned)), 1.0, pushed)
    by_plane = combined(pull, by_plane, 1.0, combined(by_residual, offset, 1.0, cross(by_torque, arm)))
    by_arm = combined(1.0, cross(plane, by_torque), 1.0, by_offset)
    by_turned = combined(1.0, combined(1.0, cross(offset, by_torque), 1.0, by_plane), 1.0, turned_to)
    by_facing = combined(sign, by_plane, 1.0, facing_to)
    return by_arm, by_turned, by_facing, by_offset, unit * term, warming, spread


@compiled()
def _halves(vector):  # type: ignore[no-untyped-def]
    return (vector[0], vector[1], vector[2]), (vector[3], vector[4], vector[5])


@compiled()
def add_step(clouds, pairs, at, solved, out):  # type: ignore[no-untyped-def]
    """Add what a step hands on to ``out``, a ``SquaresAdjoint``; by the temperature and the spacing's logarithm.

    Parameters
    ----------
    pairs: index and mutual, ``(m,)`` each.
    at: pose and temperature.
    solved: z ``(6,)``, x ``(6,)`` and s, see above.
    """
    (index, mutual), (pose, temperature), (z, x, share) = pairs, at, solved
    along, rates, rotation = (_halves(z), _halves(x), share), np.zeros(len(index)), pose[0]
    scale, heat, spread = scale_of(clouds, index, mutual), 0.0, 0.0
    by_rotation, by_translation, by_P, by_Q, by_P_normals, by_Q_normals, by_P_weights, by_Q_weights = out
    for j in range(len(index)):
        if not mutual[j]:
            continue
        i = index[j]
        weight, placed = scale * clouds.P_weights[i] * clouds.Q_weights[j], place_of(clouds, i, j, pose)
        found = _cotangents(clouds, placed, weight, temperature, along)
        arm, turned, facing, offset, rates[j], warming, spreading = found
        heat += warming
        spread += spreading
        for k in range(3):
            by_translation[k] += offset[k]
            by_P[k, i] -= offset[k]
            by_P_normals[k, i] += facing[k]
            for axis in range(3):
                by_rotation[k, axis] += arm[k] * clouds.Q[j, axis] + turned[k] * clouds.Q_normals[j, axis]
                by_Q[axis, j] += arm[k] * rotation[k, axis]
                by_Q_normals[axis, j] += turned[k] * rotation[k, axis]
    add_weights(clouds, pairs, rates, by_P_weights, by_Q_weights)
    return heat, spread
