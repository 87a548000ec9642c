"""Vectors of space and rotation vectors, compiled: three numbers at a time."""

import math

import numpy as np

from bbr_layer.kernels.cpu_compiling import exact

# Below this angle (rad) the factors of the exponential's derivative are taken from their series, cut after the third
# term: its error there is below 1e-16.
SMALL_ANGLE = 1e-2


@exact
def cross(a, b):  # type: ignore[no-untyped-def]
    """The cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@exact
def apply(matrix, vector):  # type: ignore[no-untyped-def]
    """A matrix ``(3, 3)`` times a vector."""
    x, y, z = vector
    return (
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )


@exact
def apply_transposed(matrix, vector):  # type: ignore[no-untyped-def]
    """The transpose of a matrix ``(3, 3)`` times a vector."""
    x, y, z = vector
    return (
        matrix[0, 0] * x + matrix[1, 0] * y + matrix[2, 0] * z,
        matrix[0, 1] * x + matrix[1, 1] * y + matrix[2, 1] * z,
        matrix[0, 2] * x + matrix[1, 2] * y + matrix[2, 2] * z,
    )


@exact
def product(a, b):  # type: ignore[no-untyped-def]
    """The product of two matrices ``(3, 3)``."""
    out = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


@exact
def _factors(angle):  # type: ignore[no-untyped-def]
    """``sin(a) / a``, ``(1 - cos a) / a^2`` and ``(a - sin a) / a^3``."""
    square = angle * angle
    if angle < SMALL_ANGLE:
        return (
            1 - square / 6 + square**2 / 120,
            0.5 - square / 24 + square**2 / 720,
            1 / 6 - square / 120 + square**2 / 5040,
        )
    half = math.sin(angle / 2) / angle
    return math.sin(angle) / angle, 2 * half * half, (angle - math.sin(angle)) / (square * angle)


@exact
def exponential(vector):  # type: ignore[no-untyped-def]
    """The rotation ``(3, 3)`` of a rotation vector (Rodrigues' formula)."""
    x, y, z = vector
    sine, versine, _ = _factors(math.sqrt(x * x + y * y + z * z))
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2] = (
        1 - versine * (y * y + z * z),
        versine * x * y - sine * z,
        versine * x * z + sine * y,
    )
    out[1, 0], out[1, 1], out[1, 2] = (
        versine * x * y + sine * z,
        1 - versine * (x * x + z * z),
        versine * y * z - sine * x,
    )
    out[2, 0], out[2, 1], out[2, 2] = (
        versine * x * z - sine * y,
        versine * y * z + sine * x,
        1 - versine * (x * x + y * y),
    )
    return out


@exact
def through_exponential(vector, torque):  # type: ignore[no-untyped-def]
    """Pull a torque on ``exp(w)`` back to w: ``J^T torque``, where ``d exp(w) = hat(J dw) exp(w)``.

    ``J = I + b hat(w) + c hat(w)^2`` with the last two factors above; transposing turns the sign of b.
    """
    x, y, z = vector
    _, b, c = _factors(math.sqrt(x * x + y * y + z * z))
    once = cross(vector, torque)
    twice = cross(vector, once)
    return (
        torque[0] - b * once[0] + c * twice[0],
        torque[1] - b * once[1] + c * twice[1],
        torque[2] - b * once[2] + c * twice[2],
    )


@exact
def axial(matrix):  # type: ignore[no-untyped-def]
    """``<M, hat(e_k)>`` for each axis k: the torque of a force M on a matrix that turns."""
    return matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]
