"""All Gauss-Newton steps of F as one node of the graph, without a tensor between them.

Backward takes the steps in reverse: each is computed again under autograd at the pose where it began, its buddies held.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bbr_layer.embedding import AXES, matrices_in_space
from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.charts import RotationVector, State
from bbr_layer.inner.gauss_newton import LONGEST_STEP, shortened, solved
from bbr_layer.inner.squares_step import BoundSquares
from bbr_layer.kernels.cpu_matched import MatchedClouds, equations_of, matched_clouds
from bbr_layer.kernels.cpu_turns import exponential
from bbr_layer.kernels.squares import MatchedSquares
from bbr_layer.once import once
from bbr_layer.pair import CloudPair
from bbr_layer.threads import side_by_side
from bbr_layer.trees import in_space


class Steps(NamedTuple):
    """Which steps are taken.

    Parameters
    ----------
    bound: the loss on its pair.
    damping: see ``GaussNewton``.
    seen: the step, counted from the first one taken, before which the pose is also told.
    """

    bound: BoundSquares
    damping: float
    seen: int


class Walked(NamedTuple):
    """Where the steps led, ``(batch, d, d)`` and ``(batch, d)``.

    Without a graph: the last slope's length ``(batch,)``, and the pose before the step that is seen.
    """

    rotation: Tensor
    translation: Tensor
    slope_norm: Tensor
    seen_rotation: Tensor
    seen_translation: Tensor


def walk(steps: Steps, start: State, temperatures: Tensor) -> Walked:
    """Take steps of Gauss-Newton on F from ``start``, at ``temperatures (steps, batch)``; once differentiable."""
    return Walked(*_Walk.apply(steps, temperatures, *start, *steps.bound.pair))


class _Poses(NamedTuple):
    """Poses in space around all steps, ``(batch, steps + 1, ...)``; slopes ``(batch, steps, 6)``."""

    rotations: np.ndarray
    translations: np.ndarray
    slopes: np.ndarray

    def at(self, step: int, d: int) -> RigidMotion:
        """One pose of all items, in the space of the data."""
        parts = self.rotations[:, step, :d, :d], self.translations[:, step, :d]
        return RigidMotion(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts))


class _Walk(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, steps: Steps, temperatures: Tensor, *rest: Any) -> tuple[Tensor, ...]:
        rotation, translation, *fields = rest
        pair, (batch, d), count = CloudPair._make(fields), translation.shape, len(temperatures)
        poses = _Poses(*(np.empty((batch, *shape)) for shape in ((count + 1, 3, 3), (count + 1, 3), (count, 6))))
        poses.rotations[:, 0] = matrices_in_space(rotation.numpy())
        poses.translations[:, 0] = in_space(translation.numpy())
        squares = steps.bound.squares
        assert isinstance(squares, MatchedSquares)
        clouds, heats = matched_clouds(pair, squares.reach, squares.alike), temperatures.numpy()
        settings = squares, AXES[d], steps.damping
        side_by_side(lambda b: _descend(settings, (b, clouds[b]), heats[:, b], _Poses(*(x[b] for x in poses))), batch)
        ctx.steps, ctx.poses = steps, poses
        ctx.save_for_backward(temperatures, *rest)
        norm = torch.from_numpy(np.linalg.norm(poses.slopes[:, -1], axis=1))
        seen = poses.at(steps.seen, d)
        ctx.mark_non_differentiable(norm, *seen)
        return *poses.at(count, d), norm, *seen

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
        saved = ctx.saved_tensors  # read once: a checkpoint gives them once
        temperatures, _, translation, *fields = saved
        pair, d = CloudPair._make(fields), translation.shape[-1]
        by_pose, by_heats = cotangents[:2], torch.zeros_like(temperatures)
        by_pair: list[Tensor | None] = [None] * len(fields)
        for step in reversed(range(len(temperatures))):
            at, heat = ctx.poses.at(step, d), temperatures[step]
            by_pose, by_heats[step], parts = _pulled_back(ctx.steps, pair, (at, heat), by_pose)
            by_pair = [a if b is None else b if a is None else a + b for a, b in zip(by_pair, parts, strict=True)]
        found = [by_heats, *by_pose, *by_pair]
        return None, *once(found, (*saved, *cotangents))


def _descend(
    settings: tuple[MatchedSquares, list[int], float],
    item: tuple[int, MatchedClouds],
    temperatures: np.ndarray,
    poses: _Poses,
) -> None:
    """Take one item along all steps."""
    (squares, axes, damping), (number, clouds) = settings, item
    for step, temperature in enumerate(temperatures):
        pose = poses.rotations[step], poses.translations[step]
        matrix, slope = equations_of(clouds, squares.search.of_item(number, pose), pose, temperature)
        move = _step(matrix[np.ix_(axes, axes)], slope[axes], damping)
        whole = np.zeros(6)
        whole[axes] = move
        length = max(float(np.linalg.norm(whole[:3])), float(np.linalg.norm(whole[3:])), LONGEST_STEP)
        whole *= LONGEST_STEP / length
        poses.slopes[step] = 0.0
        poses.slopes[step, axes] = slope[axes]
        poses.rotations[step + 1] = exponential(tuple(whole[:3])) @ pose[0]
        poses.translations[step + 1] = pose[1] + whole[3:]


def _step(matrix: np.ndarray, slope: np.ndarray, damping: float) -> np.ndarray:
    """As ``solved``; not finite where the equations have no single solution."""
    mean = matrix.trace() / len(matrix)
    safe = matrix + damping * mean * np.eye(len(matrix)) if mean > 0 else np.eye(len(matrix))
    try:
        return -np.linalg.solve(safe, slope)
    except np.linalg.LinAlgError:
        return np.full(len(slope), np.nan)


def _pulled_back(
    steps: Steps, pair: CloudPair, at: tuple[RigidMotion, Tensor], by_end: tuple[Tensor, ...]
) -> tuple[tuple[Tensor, ...], Tensor, list[Tensor | None]]:
    """Cotangents of the end of a step taken to its beginning: by the pose, the temperature, and the fields."""
    squares = steps.bound.squares
    held = squares.hold(at[0])
    with torch.enable_grad():
        leaves = [x.detach().requires_grad_() for x in (*at[0], at[1])]
        fields = [None if x is None else x.detach().requires_grad_(x.is_floating_point()) for x in pair]
        motion = RigidMotion(*leaves[:2])
        equations = squares.equations(CloudPair._make(fields), motion, leaves[2], held)
        move = shortened(solved(equations, steps.damping), motion.dimension)
        end = RotationVector().moved(State(*motion), move)
    wanted = [*leaves, *(x for x in fields if x is not None and x.requires_grad)]
    found = torch.autograd.grad(end, wanted, by_end, allow_unused=True, materialize_grads=False)
    parts = iter(found[3:])
    by_fields = [next(parts) if x is not None and x.requires_grad else None for x in fields]
    by_rotation, by_translation, by_heat = (
        torch.zeros_like(x) if g is None else g for g, x in zip(found[:3], leaves, strict=True)
    )
    return (by_rotation, by_translation), by_heat, by_fields
