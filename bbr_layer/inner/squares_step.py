"""One Gauss-Newton step as a node of the graph: its backward computes the step again, so that nothing is stored."""

from typing import Any

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.gauss_newton import solved
from bbr_layer.kernels.squares import Squares
from bbr_layer.once import once
from bbr_layer.pair import CloudPair


class BoundSquares:
    """The normal equations of a loss on one pair of clouds, and the steps that solve them.

    Parameters
    ----------
    squares: the loss as least squares.
    pair: the clouds, the source not yet moved.
    stored: True keeps every step's graph, which can be differentiated again; False computes it anew in backward.
    """

    def __init__(self, squares: Squares, pair: CloudPair, stored: bool):
        self.squares, self.pair, self.stored = squares, pair, stored

    def detach(self) -> "BoundSquares":
        """The same, cut from the graph."""
        return BoundSquares(self.squares, self.pair.detach(), self.stored)

    def step(self, motion: RigidMotion, temperature: Tensor, damping: float) -> tuple[Tensor, Tensor]:
        """The turn and shift ``(batch, k)`` to take at ``motion``, and the slope there, ``(batch, k)``."""
        held = self.squares.hold(motion.detach())
        if self.stored:
            equations = self.squares.equations(self.pair, motion, temperature, held)
            return solved(equations, damping), equations.slope
        return _Step.apply(self, damping, held, temperature, *motion, *self.pair)


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, bound: BoundSquares, damping: float, held: tuple[Tensor, ...], temperature: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor]:
        motion, pair = RigidMotion(*rest[:2]), CloudPair._make(rest[2:])
        equations = bound.squares.equations(pair, motion, temperature, held)
        ctx.bound, ctx.damping, ctx.held = bound, damping, held
        ctx.save_for_backward(temperature, *rest)
        ctx.mark_non_differentiable(equations.slope)
        return solved(equations, damping), equations.slope

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor, _: Tensor) -> tuple[Any, ...]:
        saved = ctx.saved_tensors
        with torch.enable_grad():
            given = [None if x is None else x.detach().requires_grad_(x.is_floating_point()) for x in saved]
            motion, pair = RigidMotion._make(given[1:3]), CloudPair._make(given[3:])
            step = solved(ctx.bound.squares.equations(pair, motion, given[0], ctx.held), ctx.damping)
        wanted = [x for x in given if x is not None and x.requires_grad]
        found = iter(torch.autograd.grad(step, wanted, cotangent.detach(), allow_unused=True))
        answers = [next(found) if x is not None and x.requires_grad else None for x in given]
        return None, None, None, *once(answers, (*saved, cotangent))
