"""Gauss-Newton steps of F on one item, and their adjoint: numpy and what is compiled, no tensors.

Poses of the plane are embedded in space: a step has six components, the turn first, of which some are not free.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bbr_layer.inner.gauss_newton import LONGEST_STEP
from bbr_layer.kernels.cpu_matched import MatchedClouds, equations_of
from bbr_layer.kernels.cpu_squares_adjoint import SquaresAdjoint, add_step
from bbr_layer.kernels.cpu_turns import axial, exponential, product, through_exponential
from bbr_layer.margins import Pose


class Trace(NamedTuple):
    """Poses around all steps, ``(steps + 1, 3, 3)`` and ``(steps + 1, 3)``, and equations, ``(steps, 6, 6)`` and 6."""

    rotations: np.ndarray
    translations: np.ndarray
    matrices: np.ndarray
    slopes: np.ndarray


class Item(NamedTuple):
    """One item on its way.

    Parameters
    ----------
    search: at a pose, indices of the nearest target points and which choices are mutual, ``(m,)`` each.
    temperatures: ``(steps,)``.
    trace: begun at its first pose.
    axes: components of a step that are free.
    damping: see ``GaussNewton``.
    """

    search: Callable[[Pose], tuple[np.ndarray, np.ndarray]]
    clouds: MatchedClouds
    temperatures: np.ndarray
    trace: Trace
    axes: list[int]
    damping: float


def descend(item: Item) -> None:
    """Take one item along all steps."""
    trace = item.trace
    for step, temperature in enumerate(item.temperatures):
        pose = trace.rotations[step], trace.translations[step]
        equations = equations_of(item.clouds, item.search(pose), pose, temperature)
        trace.matrices[step], trace.slopes[step] = equations
        move, share = _move(item, step)
        trace.rotations[step + 1] = exponential(tuple(share * move[:3])) @ pose[0]
        trace.translations[step + 1] = pose[1] + share * move[3:]


def ascend(item: Item, adjoint: SquaresAdjoint) -> tuple[np.ndarray, float]:
    """Take cotangents of an item's end back to its start; those of the temperatures and of the spacing's logarithm."""
    trace, by_temperatures, by_spacing = item.trace, np.empty(len(item.temperatures)), 0.0
    for step in reversed(range(len(item.temperatures))):
        move, share = _move(item, step)
        turn = tuple(share * move[:3])
        torque = axial(product(adjoint.rotation, trace.rotations[step + 1].T))
        by_move = share * np.array((*through_exponential(turn, torque), *adjoint.translation))
        adjoint.rotation[:] = exponential(turn).T @ adjoint.rotation
        held = _solved(item, step, by_move)
        solved = held, move, item.damping * float(held @ move) / len(item.axes)
        at = (trace.rotations[step], trace.translations[step]), item.temperatures[step]
        by_temperatures[step], spread = add_step(item.clouds, item.search(at[0]), at, solved, adjoint)
        by_spacing += spread
    return by_temperatures, by_spacing


def _move(item: Item, step: int) -> tuple[np.ndarray, float]:
    """The turn and shift ``(6,)`` that solve the equations of a step, and the share of them that it takes."""
    move = _solved(item, step, item.trace.slopes[step])
    length = max(float(np.linalg.norm(move[:3])), float(np.linalg.norm(move[3:])), LONGEST_STEP)
    return move, LONGEST_STEP / length


def _solved(item: Item, step: int, slope: np.ndarray) -> np.ndarray:
    """As ``step_of``, of the equations of a step with any ``slope (6,)``; 0 where the pose is not free."""
    whole, axes = np.zeros(6), item.axes
    whole[axes] = step_of(item.trace.matrices[step][np.ix_(axes, axes)], slope[axes], item.damping)
    return whole


def step_of(matrix: np.ndarray, slope: np.ndarray, damping: float) -> np.ndarray:
    """As ``solved``; not finite where the equations have no single solution."""
    mean = matrix.trace() / len(matrix)
    safe = matrix + damping * mean * np.eye(len(matrix)) if mean > 0 else np.eye(len(matrix))
    try:
        return -np.linalg.solve(safe, slope)
    except np.linalg.LinAlgError:
        return np.full(len(slope), np.nan)
