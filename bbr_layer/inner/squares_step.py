"""One Gauss-Newton step as a node of the graph: its backward computes the step again, so that nothing is stored."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from bbr_layer.embedding import AXES, matrices_in_space
from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.gauss_newton import solved
from bbr_layer.inner.once import once
from bbr_layer.kernels.choice import backend
from bbr_layer.kernels.squares import Equations, MatchedSquares, Squares
from bbr_layer.pair import CloudPair
from bbr_layer.trees import in_space


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
        self._clouds: list | None = None

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

    def values(self, motion: RigidMotion, temperature: Tensor, held: tuple[Tensor, ...]) -> Equations:
        """The normal equations without a graph, compiled where they can be."""
        compiled = self.pair.P.device.type == "cpu" and backend("cpu").name == "numba"
        if not isinstance(self.squares, MatchedSquares) or not compiled:
            return self.squares.equations(self.pair.detach(), motion, temperature, held)
        # Imported where it is used: Numba takes long to load, and may be missing.
        from bbr_layer.kernels.cpu_matched import equations_of, matched_clouds

        if self._clouds is None:
            self._clouds = matched_clouds(self.pair, self.squares.reach)
        pose = matrices_in_space(motion.rotation.numpy()), in_space(motion.translation.numpy())
        pairs = zip(*(x.numpy() for x in held), strict=True)
        each = zip(self._clouds, pairs, zip(*pose, strict=True), temperature.tolist(), strict=True)
        found = [equations_of(*item) for item in each]
        axes = AXES[motion.dimension]
        matrices, slopes = (torch.from_numpy(np.stack(x)) for x in zip(*found, strict=True))
        return Equations(matrices[:, axes][:, :, axes], slopes[:, axes])


class _Step(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, bound: BoundSquares, damping: float, held: tuple[Tensor, ...], temperature: Tensor, *rest: Any
    ) -> tuple[Tensor, Tensor]:
        equations = bound.values(RigidMotion(*rest[:2]), temperature, held)
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
