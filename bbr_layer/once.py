"""Refusing, in words, a derivative of a derivative that is not there."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

MESSAGE = (
    "there are first derivatives only here, and a second one was asked for (create_graph=True, jvp or hessian): a "
    "layer gives it by BBRLayer(..., backward=Autograd()), its normals given, outside torch.func "
    "(torch.autograd.functional.hessian)"
)


def once(values: Iterable[Tensor | None], anchors: Iterable[Tensor | None]) -> tuple[Tensor | None, ...]:
    """The values of a backward pass, as they are; differentiating them by the ``anchors`` raises a RuntimeError.

    Without this, a second derivative would silently lack a part.
    """
    tied = [x for x in anchors if x is not None and x.requires_grad]
    if not torch.is_grad_enabled() or not tied:
        return tuple(values)
    return tuple(None if value is None else _Refused.apply(value, *tied) for value in values)


class _Refused(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, *anchors: Tensor) -> Tensor:
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor) -> Any:
        raise RuntimeError(MESSAGE)


def only_once(value: Tensor, anchor: Tensor) -> Tensor:
    """A value whose first derivative by ``anchor``, a tensor that it comes from, is right, and no other one."""
    answer: Tensor = _First.apply(value, anchor)
    return answer


class _First(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, anchor: Tensor) -> Tensor:
        ctx.save_for_backward(anchor)
        return value.clone()

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return *once([cotangent], [*ctx.saved_tensors, cotangent]), None
