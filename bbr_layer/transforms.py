"""The layer under ``torch.func``: one operation with a rule for ``vmap`` and one for ``grad``.

The layer reads numbers out of its tensors (trees, compiled sweeps), which the wrapped tensors of ``torch.func`` do not
allow. As an operation it is given the tensors inside.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.once import MESSAGE
from bbr_layer.pair import CloudPair
from bbr_layer.registration import Registration

Register = Callable[[CloudPair, RigidMotion | None], Registration]
# The first outputs of a registration are differentiable: rotation, translation, loss, temperature.
DIFFERENTIABLE = 4


def is_transformed(given: CloudPair, start: RigidMotion | None) -> bool:
    """Whether any tensor is wrapped by ``torch.func``."""
    tensors = (*given, *(start if isinstance(start, RigidMotion) else ()))  # the door has a sentence for anything else
    return any(isinstance(x, Tensor) and torch._C._functorch.is_functorch_wrapped_tensor(x) for x in tensors)


def registered(register: Register, given: CloudPair, start: RigidMotion | None) -> Registration:
    """``register(given, start)``, whatever wraps its tensors; only what is given is differentiable, once."""
    rotation, translation = (None, None) if start is None else start
    answer = _Registered.apply(register, rotation, translation, *given)
    return Registration(RigidMotion(*answer[:2]), *answer[2:])


def _called(register: Register, tensors: tuple[Tensor | None, ...]) -> tuple[Tensor, ...]:
    start = None if tensors[0] is None or tensors[1] is None else RigidMotion(tensors[0], tensors[1])
    result = register(CloudPair._make(tensors[2:]), start)
    return *result.target_from_source, *result[1:]


class _Registered(torch.autograd.Function):
    @staticmethod
    def forward(register: Register, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return _called(register, tensors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.register = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.mark_non_differentiable(*output[DIFFERENTIABLE:])

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Any, ...]:
        saved = ctx.saved_tensors
        pulled = _PulledBack.apply(ctx.register, len(saved), *saved, *cotangents[:DIFFERENTIABLE])
        fitting = iter(pulled)
        return None, *(next(fitting) if _moves(x) else None for x in saved)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(MESSAGE)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], register: Register, *tensors: Tensor | None) -> Any:
        return _over_batch(info.batch_size, in_dims[1:], tensors, lambda flat: _Registered.apply(register, *flat))


class _PulledBack(torch.autograd.Function):
    """The backward pass, again an operation: the registration is run once more, and differentiated."""

    @staticmethod
    def forward(register: Register, count: int, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        given, cotangents = tensors[:count], tensors[count:]
        with torch.enable_grad():
            leaves = [x.detach().requires_grad_() if x is not None and _moves(x) else x for x in given]
            outputs = _called(register, tuple(leaves))[:DIFFERENTIABLE]
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
    def vmap(info: Any, in_dims: tuple[Any, ...], register: Register, count: int, *tensors: Tensor | None) -> Any:
        operation = lambda flat: _PulledBack.apply(register, count, *flat)  # noqa: E731
        return _over_batch(info.batch_size, in_dims[2:], tensors, operation)


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
