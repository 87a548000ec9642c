"""The adjoint of the slope of F by everything, compiled; see ``matched.py``."""

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_matched import combined, dot, place_of, scale_of, steepness_of
from bbr_layer.kernels.cpu_turns import cross


@compiled()
def _rates(placed, counted, temperature, along):  # type: ignore[no-untyped-def]
    """How a pair's force and torque change along ``(turn, shift)``: their cotangents in the source's turned frame.

    ``counted`` is (weight, one over the reach). Answers with pull and twist, the plain rates of force and torque, the
    rate of the distance as it counts and that of the loss's derivative by the temperature.
    """
    arm, turned, offset, plane, _ = placed
    (turn, shift), (weight, flat) = along, counted
    velocity, spin = combined(1.0, cross(turn, arm), 1.0, shift), cross(turn, turned)
    residual = dot(offset, plane)
    residual_rate = dot(velocity, plane) + dot(offset, spin)
    squared = residual * residual + temperature * temperature
    inverse = 1 / np.sqrt(squared) if squared > 0 else 0.0
    rate, steepness = residual * residual_rate * inverse, steepness_of(flat, temperature, np.sqrt(squared))
    slope = steepness * steepness
    over, bend = weight * slope * inverse, (2 * steepness * flat / temperature if flat > 0 else 0.0)
    over_rate = -over * rate * (inverse + bend)
    warming = temperature * over_rate
    if flat > 0:
        warming += 2 * weight * (1 - steepness) * slope * rate / temperature
    push, push_rate = over * residual, over_rate * residual + over * residual_rate
    force_rate, torque_rate = combined(push_rate, plane, push, spin), combined(push_rate, offset, push, velocity)
    pull = combined(1.0, force_rate, -push, cross(turn, plane))
    twist = combined(1.0, torque_rate, -push, cross(turn, offset))
    return pull, twist, force_rate, torque_rate, slope * rate, warming


@compiled()
def add_adjoint(clouds, pairs, pose, heated, out):  # type: ignore[no-untyped-def]
    """Adjoint of ``along . slope``, ``heated`` being (temperature, along); its derivative by the temperature.

    Added into ``out``: by rotation ``(3, 3)``, translation, and P, Q and their normals ``(3, points)``. The rates of
    the distances ``(m,)`` come back too: the weights' adjoint follows from them.
    """
    (index, mutual), (temperature, direction) = pairs, heated
    by_rotation, by_translation, by_P, by_Q, by_P_normals, by_Q_normals = out
    along = (direction[0], direction[1], direction[2]), (direction[3], direction[4], direction[5])
    rotation, scale, heat, rates = pose[0], scale_of(clouds, index, mutual), 0.0, np.zeros(len(index))
    for j in range(len(index)):
        if not mutual[j]:
            continue
        i = index[j]
        placed = place_of(clouds, i, j, pose)
        counted = scale * clouds.P_weights[i] * clouds.Q_weights[j], clouds.flat
        pull, twist, force_rate, torque_rate, rates[j], warming = _rates(placed, counted, temperature, along)
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
    scale, mean = scale_of(clouds, index, mutual), 0.0
    for j in range(len(index)):
        if mutual[j]:
            mean += scale * clouds.P_weights[index[j]] * clouds.Q_weights[j] * rates[j]
    for j in range(len(index)):
        if mutual[j]:
            i = index[j]
            by_P_weights[i] += (rates[j] - mean) * clouds.Q_weights[j] * scale
            by_Q_weights[j] += (rates[j] - mean) * clouds.P_weights[i] * scale
