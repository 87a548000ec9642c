"""Many steps of the unroll as one node of the graph, item by item on plain threads.

Nothing between the steps is a tensor. Backward walks the steps in reverse; each asks for one directional derivative of
the loss's gradient.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from bbr_layer.embedding import AXES, matrices_in_space
from bbr_layer.inner.adam import Adam
from bbr_layer.inner.cotangents import as_field, item_of, room
from bbr_layer.kernels.cpu_adam import Back, Course, Trace
from bbr_layer.kernels.cpu_course import Adjoint
from bbr_layer.once import once
from bbr_layer.pair import CloudPair
from bbr_layer.threads import side_by_side
from bbr_layer.trees import in_space


class Scene(Protocol):
    """A batch of pairs of clouds under one loss; see ``CompiledScene``."""

    def walk(self, number: int, course: Course, trace: Trace) -> None: ...

    def walk_back(
        self,
        number: int,
        course: Course,
        trace: Trace,
        out: tuple[Back, Adjoint],
        by_course: tuple[np.ndarray, np.ndarray],
    ) -> None: ...


class Steps(NamedTuple):
    """Which steps are taken, and how.

    Parameters
    ----------
    look: makes the loss's scene from the pair and the rounding ``(batch,)``.
    inner: the optimiser.
    done: steps of this stage taken before.
    seen: the step of this stage before which the pose is also told.
    noise, summed: as ``Course`` has them.
    """

    look: Callable[[CloudPair, Tensor], Scene]
    inner: Adam
    done: int
    seen: int
    noise: float
    summed: bool

    def course(self, temperatures: Tensor, rates: Tensor, dimension: int) -> Callable[[int], Course]:
        """How each item goes, from ``(steps, batch)`` and ``(steps, k)``."""
        free, axes = np.zeros(6), AXES[dimension]
        free[axes] = 1
        heats, constants = np.ascontiguousarray(temperatures.numpy().T), (*self.inner.betas, self.inner.eps)
        common = _spread(rates, axes), free, constants, self.inner.shared, self.done, self.noise, self.summed
        return lambda b: Course(heats[b], *common)


class Walked(NamedTuple):
    """Where the steps led: ``(batch, d, d)``, ``(batch, d)``, moments ``(batch, k)``.

    Without a graph: the last gradient's length ``(batch,)``, and the pose before the step that is seen.
    """

    rotation: Tensor
    translation: Tensor
    first: Tensor
    second: Tensor
    gradient_norm: Tensor
    seen_rotation: Tensor
    seen_translation: Tensor


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
        scene, course = steps.look(pair, rounding), steps.course(temperatures, rates, d)
        trace = _begun(len(temperatures), rotation, translation, first, second)
        side_by_side(lambda b: scene.walk(b, course(b), item_of(trace, b)), len(translation))
        ctx.steps, ctx.trace = steps, trace
        ctx.save_for_backward(*given)
        norm = torch.from_numpy(np.linalg.norm(trace.gradients[:, -1], axis=1))
        end, seen = _free(_at(trace, -1), d), _free(_at(trace, steps.seen - steps.done), d)[:2]
        ctx.mark_non_differentiable(norm, *seen)
        return *end, norm, *seen

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
        saved = ctx.saved_tensors  # read once: a checkpoint gives them once
        with torch.no_grad():
            found = _Walk.pulled_back(ctx, saved, cotangents)
        return None, *once(found, (*saved, *cotangents))

    @staticmethod
    def pulled_back(ctx: Any, saved: tuple[Any, ...], cotangents: tuple[Tensor, ...]) -> list[Tensor | None]:
        """Cotangents of everything that is saved, in order."""
        rounding, temperatures, rates, _, translation, _, _, *fields = saved
        pair, d, steps = CloudPair._make(fields), translation.shape[-1], ctx.steps
        scene, course = steps.look(pair, rounding), steps.course(temperatures, rates, d)
        (count, batch), axes = temperatures.shape, AXES[d]
        adjoint = _zero(pair)
        moments = (_spread(x, axes) for x in cotangents[2:4])
        back = Back(matrices_in_space(cotangents[0].numpy(), 0.0), in_space(cotangents[1].numpy()).copy(), *moments)
        heats, speeds = np.zeros((batch, count)), np.zeros((batch, count, 6))

        def work(b: int) -> None:
            scene.walk_back(
                b, course(b), item_of(ctx.trace, b), (item_of(back, b), item_of(adjoint, b)), (heats[b], speeds[b])
            )

        side_by_side(work, batch)
        lengths = adjoint.rounding[:, 0], heats.T, speeds.sum(axis=0)[:, axes]
        by_lengths = [torch.from_numpy(np.ascontiguousarray(x)) for x in lengths]
        by_fields = [as_field(adjoint, name, getattr(pair, name)) for name in CloudPair._fields]
        return [*by_lengths, *_free(back, d), *by_fields]


def _begun(steps: int, rotation: Tensor, translation: Tensor, first: Tensor, second: Tensor) -> Trace:
    """A batch of traces with room for all steps, at their first point."""
    batch, axes = len(translation), AXES[translation.shape[-1]]
    shapes = (steps + 1, 3, 3), (steps + 1, 3), (steps + 1, 6), (steps + 1, 6), (steps, 6)
    trace = Trace(*(np.zeros((batch, *shape)) for shape in shapes))
    starts = (
        matrices_in_space(rotation.numpy()),
        in_space(translation.numpy()),
        _spread(first, axes),
        _spread(second, axes),
    )
    for table, values in zip(trace, starts, strict=False):
        table[:, 0] = values
    return trace


def _zero(pair: CloudPair) -> Adjoint:
    sides = (pair.P_features, pair.P), (pair.Q_features, pair.Q)
    features = [(len(points), 0 if x is None else x.shape[-1], points.shape[1]) for x, points in sides]
    return Adjoint(*room(pair), *(np.zeros(shape) for shape in ((len(pair.P), 1), *features)))


def _at(trace: Trace, step: int) -> Back:
    """One point of all traces."""
    return Back(trace.rotations[:, step], trace.translations[:, step], trace.firsts[:, step], trace.seconds[:, step])


def _free(point: Back, d: int) -> list[Tensor]:
    """A point in the space of the data, without what is not free."""
    axes = AXES[d]
    tables = point.rotation[:, :d, :d], point.translation[:, :d], point.first[:, axes], point.second[:, axes]
    return [torch.from_numpy(np.ascontiguousarray(table)) for table in tables]


def _spread(values: Tensor, axes: list[int]) -> np.ndarray:
    """Free components ``(rows, k)`` in six columns."""
    whole = np.zeros((len(values), 6))
    whole[:, axes] = values.numpy()
    return whole
