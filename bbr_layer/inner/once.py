"""Refusing, in words, a derivative of a derivative that is not there."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

MESSAGE = (
    "Replay(), Truncated() and Implicit() give first derivatives only, and a second one was asked for "
    "(create_graph=True, torch.func.jvp or hessian): use BBRLayer(..., backward=Autograd())"
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
