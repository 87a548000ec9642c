"""Adam on a rotation vector and a translation in numpy, with its adjoint: what the compiled unroll does between sweeps.

The arithmetic is ``adam_direction``'s and the chart ``RotationVector``'s; tests tie them together. Poses of the plane
are embedded in space, so that rotations are always ``(batch, 3, 3)``; ``axes`` lists the components of a tangent
``(batch, 6)``, rotation first, that are free.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from bbr_layer.inner.adam import Adam
from bbr_layer.rotations import rotation_dimensions

AXES = {2: [2, 3, 4], 3: [0, 1, 2, 3, 4, 5]}
# Below this angle (rad) ``(a - sin a) / a^3`` is taken from its series, cut after the third term.
SMALL_ANGLE = 1e-2


class Point(NamedTuple):
    """Where the registration stands: ``(batch, 3, 3)``, ``(batch, 3)``, and moments ``(batch, k)``."""

    rotation: np.ndarray
    translation: np.ndarray
    first: np.ndarray
    second: np.ndarray


class Taken(NamedTuple):
    """What a step leaves for its adjoint: the gradient ``(batch, k)``, and the point it led to."""

    gradient: np.ndarray
    after: Point


class Totals(NamedTuple):
    """Cotangents of everything but the pose, added up over the steps; float64, channels before points.

    ``P, P_normals (b, 3, n)``, ``Q, Q_normals (b, 3, m)``, weights ``(b, n)`` and ``(b, m)``, ``rounding (b,)``.
    """

    P: np.ndarray
    Q: np.ndarray
    P_normals: np.ndarray
    Q_normals: np.ndarray
    P_weights: np.ndarray
    Q_weights: np.ndarray
    rounding: np.ndarray

    @staticmethod
    def zero(batch: int, n: int, m: int) -> "Totals":
        """Zeros for clouds of n and m points."""
        vectors, numbers = ((batch, 3, n), (batch, 3, m)), ((batch, n), (batch, m))
        return Totals(*(np.zeros(shape) for shape in (*vectors, *vectors, *numbers, (batch,))))


class HandAdam:
    """The inner optimiser's steps and their adjoints.

    Parameters
    ----------
    inner: settings.
    dimension: 2 or 3.
    """

    def __init__(self, inner: Adam, dimension: int):
        self.betas, self.eps = inner.betas, inner.eps
        self.axes, turns = AXES[dimension], rotation_dimensions(dimension)
        self.blocks = [slice(0, turns), slice(turns, turns + dimension)] if inner.shared else []

    def advance(self, at: Point, gradient: np.ndarray, rate: np.ndarray, number: int) -> Point:
        """Step ``number`` (from 1) with rates ``(k,)``."""
        first = self.betas[0] * at.first + (1 - self.betas[0]) * gradient
        second = self.betas[1] * at.second + (1 - self.betas[1]) * self._mean_in_blocks(gradient**2)
        move = self._tangent(-rate * self._direction(first, second, number)[0])
        turned = exponential(move[:, :3]) @ at.rotation
        return Point(turned, at.translation + move[:, 3:], first, second)

    def retreat(
        self, taken: Taken, cotangent: Point, rate: np.ndarray, number: int
    ) -> tuple[Point, np.ndarray, np.ndarray]:
        """The cotangent before step ``number``, but for what the gradient hands on; its own ``(batch, k)``; the rates'.

        Parameters
        ----------
        taken: the step.
        cotangent: of the point after it.
        """
        direction, root = self._direction(taken.after.first, taken.after.second, number)
        move = self._tangent(-rate * direction)[:, :3]
        turn = np.einsum(
            "bki,bk->bi", left_jacobian(move), axial(cotangent.rotation @ transposed(taken.after.rotation))
        )
        by_move = np.concatenate((turn, cotangent.translation), axis=1)[:, self.axes]
        by_direction = -rate * by_move
        moving = taken.after.second > 0
        over = np.where(moving, 1 / np.where(moving, root + self.eps, 1.0), 0.0)
        by_first = cotangent.first + by_direction * over / (1 - self.betas[0] ** number)
        by_root = -by_direction * direction * over
        unbias = (1 - self.betas[1] ** number) ** 0.5
        slope = np.where(moving, 0.5 / (np.where(moving, root, 1.0) * unbias**2), 0.0)
        by_second = cotangent.second + by_root * slope
        by_gradient = (1 - self.betas[0]) * by_first
        by_gradient += (1 - self.betas[1]) * 2 * taken.gradient * self._mean_in_blocks(by_second)
        rotation = transposed(exponential(move)) @ cotangent.rotation
        before = Point(rotation, cotangent.translation, self.betas[0] * by_first, self.betas[1] * by_second)
        return before, by_gradient, -direction * by_move

    def _direction(self, first: np.ndarray, second: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
        """The direction of the step and the root of the unbiased second moment; 0 where nothing has moved yet."""
        root, moving = np.sqrt(second) / (1 - self.betas[1] ** number) ** 0.5, second > 0
        unbiased = np.where(moving, first, 0.0) / (1 - self.betas[0] ** number)
        return unbiased / np.where(moving, root + self.eps, 1.0), root

    def _mean_in_blocks(self, values: np.ndarray) -> np.ndarray:
        if self.blocks:
            values = values.copy()
            for block in self.blocks:
                values[:, block] = values[:, block].mean(axis=1, keepdims=True)
        return values

    def _tangent(self, free: np.ndarray) -> np.ndarray:
        whole = np.zeros((len(free), 6))
        whole[:, self.axes] = free
        return whole


def transposed(matrices: np.ndarray) -> np.ndarray:
    """The transposes of ``(batch, a, b)``."""
    return np.swapaxes(matrices, -1, -2)


def hat(vectors: np.ndarray) -> np.ndarray:
    """The matrices ``(batch, 3, 3)`` of the cross products with ``(batch, 3)``."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, [2, 0, 1], [1, 2, 0]] = vectors
    matrices[:, [1, 2, 0], [2, 0, 1]] = -vectors
    return matrices


def axial(matrices: np.ndarray) -> np.ndarray:
    """``<M, hat(e_k)>`` for each axis k, ``(batch, 3)``."""
    return matrices[:, [2, 0, 1], [1, 2, 0]] - matrices[:, [1, 2, 0], [2, 0, 1]]


def exponential(vectors: np.ndarray) -> np.ndarray:
    """Rotations of rotation vectors ``(batch, 3)``, ``(batch, 3, 3)``."""
    return Rotation.from_rotvec(vectors).as_matrix()


def left_jacobian(vectors: np.ndarray) -> np.ndarray:
    """How ``exp(w)`` turns further when w changes, ``(batch, 3, 3)``: ``d exp(w) = hat(J dw) exp(w)``."""
    angle = np.sqrt((vectors**2).sum(axis=1))[:, None, None]
    generator, half = hat(vectors), np.sinc(angle / (2 * np.pi))
    small = angle < SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    cubic = np.where(small, 1 / 6 - angle**2 / 120 + angle**4 / 5040, (safe - np.sin(safe)) / safe**3)
    return np.eye(3) + 0.5 * half**2 * generator + cubic * (generator @ generator)
