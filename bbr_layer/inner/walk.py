"""Many steps of the unroll as one node of the graph.

The clouds are packed once, and nothing between the steps is a tensor. Backward walks the steps in reverse; each asks
for one directional derivative of the loss's gradient.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from bbr_layer.inner.adam import Adam
from bbr_layer.inner.adam_by_hand import HandAdam, Point, Taken, Totals
from bbr_layer.inner.once import once
from bbr_layer.pair import CloudPair
from bbr_layer.trees import in_space


@runtime_checkable
class Scene(Protocol):
    """A pair of clouds under one loss, looked at from one pose after the other; see ``CompiledScene``."""

    def totals(self) -> Totals: ...

    def slope(self, at: Point, temperature: np.ndarray) -> np.ndarray: ...

    def pull_back(
        self, at: Point, temperature: np.ndarray, along: np.ndarray, totals: Totals
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]: ...


class Steps(NamedTuple):
    """Which steps are taken, and how.

    Parameters
    ----------
    look: makes the loss's scene from the pair and the rounding ``(batch,)``.
    inner: the optimiser.
    done: steps of this stage taken before.
    """

    look: Callable[[CloudPair, Tensor], Scene]
    inner: Adam
    done: int


class Walked(NamedTuple):
    """Where the steps led: ``(batch, d, d)``, ``(batch, d)``, moments ``(batch, k)``, last gradient's ``(batch,)``."""

    rotation: Tensor
    translation: Tensor
    first: Tensor
    second: Tensor
    gradient_norm: Tensor


def walk(
    steps: Steps, clouds: tuple[CloudPair, Tensor], start: tuple[Tensor, ...], temperatures: Tensor, rates: Tensor
) -> Walked:
    """Take steps of Adam on a pose; once differentiable in everything.

    Parameters
    ----------
    clouds: the pair, the source not yet moved, and the rounding ``(batch,)``.
    start: rotation, translation and the two moments, as ``Walked``.
    temperatures: ``(steps, batch)``.
    rates: ``(steps, k)``.
    """
    pair, rounding = clouds
    return Walked(*_Walk.apply(steps, rounding, temperatures, rates, *start, *pair))


class _Walk(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, steps: Steps, *given: Any) -> tuple[Tensor, ...]:
        rounding, temperatures, rates, rotation, translation, first, second, *fields = given
        pair, d = CloudPair._make(fields), translation.shape[-1]
        scene, adam = steps.look(pair, rounding), HandAdam(steps.inner, d)
        at = Point(_embedded(rotation, 1.0), in_space(translation.numpy()), first.numpy(), second.numpy())
        points, gradients = [at], []
        for number, (temperature, rate) in enumerate(zip(temperatures.numpy(), rates.numpy(), strict=True)):
            gradient = scene.slope(at, temperature)[:, adam.axes]
            at = adam.advance(at, gradient, rate, steps.done + number + 1)
            points.append(at)
            gradients.append(gradient)
        ctx.steps, ctx.points, ctx.gradients = steps, points, gradients
        ctx.save_for_backward(*given)
        norm = torch.from_numpy(np.linalg.norm(gradients[-1], axis=1))
        ctx.mark_non_differentiable(norm)
        tables = at.rotation[:, :d, :d], at.translation[:, :d], at.first, at.second
        return *(torch.from_numpy(np.ascontiguousarray(table)) for table in tables), norm

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
        with torch.no_grad():
            found = _Walk.pulled_back(ctx, cotangents)
        return None, *once(found, (*ctx.saved_tensors, *cotangents))

    @staticmethod
    def pulled_back(ctx: Any, cotangents: tuple[Tensor, ...]) -> list[Tensor | None]:
        """Cotangents of everything that is saved, in order."""
        rounding, temperatures, rates, rotation, translation, _, _, *fields = ctx.saved_tensors
        pair, d, steps = CloudPair._make(fields), translation.shape[-1], ctx.steps
        scene, adam = steps.look(pair, rounding), HandAdam(steps.inner, d)
        totals, heats, speeds = scene.totals(), np.zeros(temperatures.shape), np.zeros(rates.shape)
        by_translation, *by_moments = (x.numpy() for x in cotangents[1:4])
        back = Point(_embedded(cotangents[0], 0.0), in_space(by_translation), *by_moments)
        for number in reversed(range(len(heats))):
            before, taken = ctx.points[number], Taken(ctx.gradients[number], ctx.points[number + 1])
            rate, count = rates[number].numpy(), steps.done + number + 1
            back, by_gradient, by_rate = adam.retreat(taken, back, rate, count)
            along = np.zeros((len(by_gradient), 6))
            along[:, adam.axes] = by_gradient
            turn, shift, heats[number] = scene.pull_back(before, temperatures[number].numpy(), along, totals)
            back = back._replace(rotation=back.rotation + turn, translation=back.translation + shift)
            speeds[number] = by_rate.sum(axis=0)
        pose = back.rotation[:, :d, :d], back.translation[:, :d], back.first, back.second
        by_pose = [torch.from_numpy(np.ascontiguousarray(x)) for x in pose]
        by_lengths = [torch.from_numpy(x) for x in (totals.rounding, heats, speeds)]
        by_fields = [_as_field(totals, name, getattr(pair, name)) for name in CloudPair._fields]
        return [*by_lengths, *by_pose, *by_fields]


def _as_field(totals: Any, name: str, field: Tensor | None) -> Tensor | None:
    """The cotangent of a field of the pair, in its shape; None for what has none."""
    if field is None or not hasattr(totals, name):
        return None
    table = torch.from_numpy(getattr(totals, name))
    return (table if field.ndim == 2 else table[:, : field.shape[-1]].mT).to(field.dtype)


def _embedded(rotation: Tensor, last: float) -> np.ndarray:
    """Matrices of the plane in space, with ``last`` on the third axis."""
    matrices = rotation.numpy()
    if matrices.shape[-1] == 3:
        return matrices
    whole = np.zeros((len(matrices), 3, 3))
    whole[:, :2, :2], whole[:, 2, 2] = matrices, last
    return whole
