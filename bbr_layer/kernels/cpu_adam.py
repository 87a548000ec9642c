"""Adam on a rotation vector and a translation with its adjoint, compiled; one item at a time.

The arithmetic is that of ``inner.adam.adam_direction`` and of the chart ``RotationVector``; tests tie them together.
Poses of the plane are embedded in space: a tangent has six components, rotation first, of which some are not free.
"""

import math
from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_compiling import exact
from bbr_layer.kernels.cpu_turns import apply_transposed, axial, exponential, product, through_exponential


class Course(NamedTuple):
    """How the steps are taken.

    Parameters
    ----------
    temperatures: ``(steps,)``.
    rates: ``(steps, 6)``.
    free: ``(6,)`` 1 where the tangent may move, else 0.
    constants: the two betas, epsilon.
    shared: whether rotation and translation each share one second moment.
    done: steps taken before.
    noise: a gradient no longer than this is rounding, and counts as 0.
    summed: whether the loss is a sum over points; ``noise`` is then over its value and times the temperature.
    """

    temperatures: np.ndarray
    rates: np.ndarray
    free: np.ndarray
    constants: tuple[float, float, float]
    shared: bool
    done: int
    noise: float
    summed: bool


class Trace(NamedTuple):
    """Where the steps led: rotations and translations ``(steps + 1, ...)``, moments alike, gradients ``(steps, 6)``."""

    rotations: np.ndarray
    translations: np.ndarray
    firsts: np.ndarray
    seconds: np.ndarray
    gradients: np.ndarray


class Back(NamedTuple):
    """Cotangents of the point that the way back has reached: ``(3, 3)``, ``(3,)``, ``(6,)``, ``(6,)``."""

    rotation: np.ndarray
    translation: np.ndarray
    first: np.ndarray
    second: np.ndarray


@exact
def _mean_in_blocks(values, free, shared):  # type: ignore[no-untyped-def]
    """The mean over the free components of rotation and of translation, in place; as they are unless ``shared``."""
    for k in range(6):
        values[k] *= free[k]
    if shared:
        for low in (0, 3):
            total = values[low] + values[low + 1] + values[low + 2]
            count = free[low] + free[low + 1] + free[low + 2]
            for k in range(low, low + 3):
                values[k] = free[k] * total / count


@exact
def _direction(first, second, constants, number):  # type: ignore[no-untyped-def]
    """The direction of step ``number`` and the root of the unbiased second moment; 0 where nothing has moved yet."""
    fast, slow, eps = constants
    direction, roots = np.zeros(6), np.zeros(6)
    for k in range(6):
        if second[k] > 0:
            roots[k] = math.sqrt(second[k] / (1 - slow**number))
            direction[k] = first[k] / (1 - fast**number) / (roots[k] + eps)
    return direction, roots


@exact
def _turn(rates, direction):  # type: ignore[no-untyped-def]
    """The rotation vector of a move."""
    return -rates[0] * direction[0], -rates[1] * direction[1], -rates[2] * direction[2]


# Loops instead of expressions of arrays: compiling those takes seconds more, most of them for the words of errors.
@exact
def advance(course, trace, step, loss):  # type: ignore[no-untyped-def]
    """From point ``step`` of the trace, along the gradient there, to the next point; rounding is taken off it."""
    noise = course.noise * (abs(loss) / course.temperatures[step] if course.summed else 1.0)
    fast, slow, _ = course.constants
    gradient, first, second = trace.gradients[step], trace.firsts[step + 1], trace.seconds[step + 1]
    squares = np.empty(6)
    for k in range(6):
        gradient[k] *= course.free[k]
        squares[k] = gradient[k] * gradient[k]
    if squares.sum() <= noise * noise:
        gradient[:], squares[:] = 0.0, 0.0
    _mean_in_blocks(squares, course.free, course.shared)
    for k in range(6):
        first[k] = fast * trace.firsts[step, k] + (1 - fast) * gradient[k]
        second[k] = slow * trace.seconds[step, k] + (1 - slow) * squares[k]
    direction, _ = _direction(first, second, course.constants, course.done + step + 1)
    turn = exponential(_turn(course.rates[step], direction))
    trace.rotations[step + 1] = product(turn, trace.rotations[step])
    for k in range(3):
        trace.translations[step + 1, k] = trace.translations[step, k] - course.rates[step, 3 + k] * direction[3 + k]


@exact
def retreat(course, trace, step, back, by_rates):  # type: ignore[no-untyped-def]
    """Take ``back`` from point ``step + 1`` to ``step``, but for what the gradient hands on.

    Answers with the gradient's cotangent; ``by_rates (steps, 6)`` gets that of the step's rates.
    """
    (fast, slow, eps), number = course.constants, course.done + step + 1
    second, gradient = trace.seconds[step + 1], trace.gradients[step]
    direction, roots = _direction(trace.firsts[step + 1], second, course.constants, number)
    vector = _turn(course.rates[step], direction)
    torque = axial(product(back.rotation, trace.rotations[step + 1].T))
    by_move, by_second, by_gradient, heard = np.zeros(6), np.zeros(6), np.zeros(6), np.any(gradient != 0)
    by_move[0], by_move[1], by_move[2] = through_exponential(vector, torque)
    for k in range(3):
        by_move[3 + k] = back.translation[k]
    for k in range(6):
        by_move[k] *= course.free[k]
        by_second[k] = back.second[k]
        by_rates[step, k] = -direction[k] * by_move[k]
        by_first = back.first[k]
        if second[k] > 0:
            by_direction = -course.rates[step, k] * by_move[k] / (roots[k] + eps)
            by_first += by_direction / (1 - fast**number)
            by_second[k] -= by_direction * direction[k] * 0.5 / (roots[k] * (1 - slow**number))
        by_gradient[k] = (1 - fast) * by_first
        back.first[k], back.second[k] = fast * by_first, slow * by_second[k]
    _mean_in_blocks(by_second, course.free, course.shared)
    for k in range(6):
        whole = course.free[k] * (by_gradient[k] + 2 * (1 - slow) * gradient[k] * by_second[k])
        by_gradient[k] = whole if heard else 0.0
    turn = exponential(vector)
    for column in range(3):
        rotation = back.rotation[:, column]
        rotation[0], rotation[1], rotation[2] = apply_transposed(turn, (rotation[0], rotation[1], rotation[2]))
    return by_gradient
