"""The layer under ``torch.func``: one operation with a rule for ``vmap`` and one for ``grad``.

The layer reads numbers out of its tensors (trees, compiled sweeps), which the wrapped tensors of ``torch.func`` do not
allow. As an operation it is given the tensors inside; rates and temperatures that are learned are among them.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from bbr_layer.geometry import RigidMotion
from bbr_layer.once import MESSAGE
from bbr_layer.pair import CloudPair
from bbr_layer.registration import Registration

Register = Callable[[CloudPair, RigidMotion | None], Registration]
# A module, and the name of a tensor that it keeps.
Place = tuple[nn.Module, str]
# The first outputs of a registration are differentiable: rotation, translation, loss, temperature.
DIFFERENTIABLE = 4


class Settled(NamedTuple):
    """A registration, and where it keeps settings that are tensors."""

    register: Register
    places: list[Place]


def places_of(module: nn.Module) -> list[Place]:
    """Where a module and all in it keep tensors: parameters, and what was given as a tensor."""
    kept = ((part, {**vars(part), **part._parameters}) for part in module.modules())
    return [(part, name) for part, own in kept for name, x in own.items() if isinstance(x, Tensor)]


def settings_of(places: list[Place]) -> list[Tensor]:
    """What is kept there now."""
    return [getattr(part, name) for part, name in places]


def is_transformed(given: CloudPair, start: RigidMotion | None = None, how: Settled | None = None) -> bool:
    """Whether any tensor of these is wrapped by ``torch.func``."""
    settings = [] if how is None else settings_of(how.places)
    # The door has a sentence for a start that is none.
    tensors = *given, *(start if isinstance(start, RigidMotion) else ()), *settings
    return any(isinstance(x, Tensor) and torch._C._functorch.is_functorch_wrapped_tensor(x) for x in tensors)


def registered(how: Settled, given: CloudPair, start: RigidMotion | None) -> Registration:
    """``how.register(given, start)``, whatever wraps its tensors and settings; differentiable in both, once."""
    rotation, translation = (None, None) if start is None else start
    answer = _Registered.apply(how, rotation, translation, *given, *settings_of(how.places))
    return Registration(RigidMotion(*answer[:2]), *answer[2:])


def _called(how: Settled, tensors: tuple[Tensor | None, ...]) -> tuple[Tensor, ...]:
    rotation, translation, *rest = tensors
    start = None if rotation is None or translation is None else RigidMotion(rotation, translation)
    count = len(CloudPair._fields)
    with _put(how.places, rest[count:]):
        result = how.register(CloudPair._make(rest[:count]), start)
    return *result.target_from_source, *result[1:]


@contextmanager
def _put(places: list[Place], values: Sequence[Tensor | None]) -> Iterator[None]:
    """Other tensors in these places, for a while: as with ``functional_call``, one thread at a time."""
    before = settings_of(places)
    try:
        _set(places, values)
        yield
    finally:
        _set(places, before)


def _set(places: list[Place], values: Sequence[Tensor | None]) -> None:
    # Past nn.Module, which lets a parameter be replaced by another one only.
    for (part, name), value in zip(places, values, strict=True):
        (part._parameters if name in part._parameters else vars(part))[name] = value  # type: ignore[assignment]


class _Registered(torch.autograd.Function):
    @staticmethod
    def forward(how: Settled, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return _called(how, tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.how = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.mark_non_differentiable(*output[DIFFERENTIABLE:])

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
        saved = ctx.saved_tensors
        pulled = _PulledBack.apply(ctx.how, len(saved), *saved, *cotangents[:DIFFERENTIABLE])
        fitting = iter(pulled)
        return None, *(next(fitting) if _moves(x) else None for x in saved)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(MESSAGE)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], how: Settled, *tensors: Tensor | None) -> Any:
        dims, first = in_dims[1:], len(tensors) - len(how.places)
        if any(dim is not None for dim in dims[first:]):
            return _one_by_one(info.batch_size, dims, tensors, lambda item: _Registered.apply(how, *item))
        operation = lambda flat: _Registered.apply(how, *flat, *tensors[first:])  # noqa: E731
        return _over_batch(info.batch_size, dims[:first], tensors[:first], operation)


class _PulledBack(torch.autograd.Function):
    """The backward pass, again an operation: the registration is run once more, and differentiated."""

    @staticmethod
    def forward(how: Settled, count: int, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        given, cotangents = tensors[:count], tensors[count:]
        with torch.enable_grad():
            leaves = [x.detach().requires_grad_() if x is not None and _moves(x) else x for x in given]
            outputs = _called(how, tuple(leaves))[:DIFFERENTIABLE]
            moving = [x for x in leaves if x is not None and x.requires_grad]
            reached = [(out, by) for out, by in zip(outputs, cotangents, strict=True) if out.requires_grad]
            found = torch.autograd.grad(
                [out for out, _ in reached], moving, [by for _, by in reached], materialize_grads=True
            )
        return tuple(found)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.save_for_backward(*(x for x in inputs[2:] if x is not None and _moves(x)))

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> Any:
        raise RuntimeError(MESSAGE)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(MESSAGE)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], how: Settled, count: int, *tensors: Tensor | None) -> Any:
        operation = lambda flat: _PulledBack.apply(how, count, *flat)  # noqa: E731
        # In one batch the derivatives by settings would be those of all items together.
        many = _one_by_one if how.places else _over_batch
        return many(info.batch_size, in_dims[2:], tensors, operation)


def _moves(values: Tensor | None) -> bool:
    """Whether a tensor can have a derivative at all: masks cannot."""
    return values is not None and values.is_floating_point()


def _over_batch(
    size: int, in_dims: tuple[Any, ...], tensors: tuple[Tensor | None, ...], operation: Callable[[Any], Any]
) -> tuple[Any, Any]:
    """Give the operation the mapped dimension as one more batch dimension in front."""
    flat: list[Tensor | None] = []
    for values, dim in zip(tensors, in_dims, strict=True):
        if values is None:
            flat.append(None)
        else:
            flat.append(values.expand(size, *values.shape) if dim is None else values.movedim(dim, 0))
    answer = operation(flat)
    return answer, (0,) * len(answer)


def _one_by_one(
    size: int, in_dims: tuple[Any, ...], tensors: tuple[Tensor | None, ...], operation: Callable[[Any], Any]
) -> tuple[Any, Any]:
    """Give the operation one item of the mapped dimension after the other."""
    answers = []
    for number in range(size):
        pairs = zip(tensors, in_dims, strict=True)
        answers.append(operation([x if x is None or dim is None else x.select(dim, number) for x, dim in pairs]))
    answer = tuple(torch.stack(parts) for parts in zip(*answers, strict=True))
    return answer, (0,) * len(answer)
