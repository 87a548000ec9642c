"""All Gauss-Newton steps of F as one node of the graph, without a tensor between them.

Backward takes the steps in reverse, item by item: each hands on what ``cpu_squares_adjoint`` says, its buddies held.
"""

from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from bbr_layer.embedding import AXES, matrices_in_space
from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.charts import State
from bbr_layer.inner.cotangents import as_field, item_of, room
from bbr_layer.inner.squares_course import Item, Trace, ascend, descend
from bbr_layer.inner.squares_step import BoundSquares
from bbr_layer.kernels.cpu_matched import matched_clouds
from bbr_layer.kernels.cpu_squares_adjoint import SquaresAdjoint
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


class _Walk(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, steps: Steps, temperatures: Tensor, *rest: Any) -> tuple[Tensor, ...]:
        rotation, translation, *fields = rest
        (batch, d), count = translation.shape, len(temperatures)
        shapes = (count + 1, 3, 3), (count + 1, 3), (count, 6, 6), (count, 6)
        trace = Trace(*(np.empty((batch, *shape)) for shape in shapes))
        trace.rotations[:, 0] = matrices_in_space(rotation.numpy())
        trace.translations[:, 0] = in_space(translation.numpy())
        items = _items(steps, CloudPair._make(fields), temperatures, trace)
        side_by_side(lambda b: descend(items[b]), batch)
        ctx.steps, ctx.trace = steps, trace
        ctx.save_for_backward(temperatures, *rest)
        norm = torch.from_numpy(np.linalg.norm(trace.slopes[:, -1], axis=1))
        seen = _motion(trace, steps.seen, d)
        ctx.mark_non_differentiable(norm, *seen)
        return *_motion(trace, count, d), norm, *seen

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
        saved = ctx.saved_tensors  # read once: a checkpoint gives them once
        with torch.no_grad():
            found = _Walk.pulled_back(ctx, saved, cotangents[:2])
        return None, *once(found, (*saved, *cotangents))

    @staticmethod
    def pulled_back(ctx: Any, saved: tuple[Any, ...], by_end: tuple[Tensor, ...]) -> list[Tensor | None]:
        """Cotangents of everything that is saved, in order."""
        temperatures, _, translation, *fields = saved
        pair, d, (count, batch) = CloudPair._make(fields), translation.shape[-1], temperatures.shape
        by_pose = matrices_in_space(by_end[0].numpy(), 0.0), in_space(by_end[1].numpy()).copy()
        adjoint = SquaresAdjoint(*by_pose, *room(pair))
        items = _items(ctx.steps, pair, temperatures, ctx.trace)
        by_temperatures, by_spacing = np.empty((count, batch)), torch.empty(batch, dtype=torch.float64)

        def work(b: int) -> None:
            by_temperatures[:, b], by_spacing[b] = ascend(items[b], item_of(adjoint, b))

        side_by_side(work, batch)
        by_pair = {name: as_field(adjoint, name, field) for name, field in pair._asdict().items()}
        if pair.spacing is not None and _squares(ctx.steps).alike:
            by_pair["spacing"] = (by_spacing / pair.spacing).to(pair.spacing.dtype)
        parts = by_temperatures, adjoint.rotation[:, :d, :d], adjoint.translation[:, :d]
        return [*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts), *by_pair.values()]


def _squares(steps: Steps) -> MatchedSquares:
    squares = steps.bound.squares
    assert isinstance(squares, MatchedSquares)
    return squares


def _items(steps: Steps, pair: CloudPair, temperatures: Tensor, trace: Trace) -> list[Item]:
    squares, heats = _squares(steps), temperatures.numpy().T
    way = AXES[pair.P.shape[-1]], steps.damping
    return [
        Item(partial(squares.search.of_item, b), clouds, heats[b], item_of(trace, b), *way)
        for b, clouds in enumerate(matched_clouds(pair, squares.reach, squares.alike))
    ]


def _motion(trace: Trace, step: int, d: int) -> RigidMotion:
    """One pose of all items, in the space of the data."""
    parts = trace.rotations[:, step, :d, :d], trace.translations[:, step, :d]
    return RigidMotion(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts))
