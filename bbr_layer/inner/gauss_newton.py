"""Gauss-Newton on a loss whose buddies are held within a step: a few large steps instead of many small ones."""

import torch
from torch import Tensor, nn

from bbr_layer.kernels.squares import Equations
from bbr_layer.rotations import rotation_dimensions

# Share of the equations' mean diagonal that is added to it, so that a direction which nothing holds stays put.
DAMPING = 1e-6
# Largest turn (radians) and shift (cloud radii) of one step: about as far as the pairs of a pose mean anything.
LONGEST_STEP = 0.5


class GaussNewton(nn.Module):
    """Settings of the inner Gauss-Newton: iteratively reweighted least squares on the loss's own weights.

    For an answer in milliseconds; the paper's optimiser is ``Adam``. The buddies are those of the pose at which a step
    begins, so that soft ones are not lowered themselves: softBBS and softBD then end where each buddy pulls its pair
    together with its weight (expectation-maximisation), near the optimum of the loss but not at it.

    Parameters
    ----------
    steps: how many. Default 20.
    damping: share of the equations' mean diagonal that is added to it (Levenberg, 1944). Default 1e-6.

    Raises
    ------
    ValueError: fewer than one step, or a negative damping.
    """

    keep = "last"

    def __init__(self, steps: int = 20, *, damping: float = DAMPING):
        super().__init__()
        self.steps, self.damping = steps, damping
        self.check()

    def check(self) -> None:
        """Raises what the class does: a setting changed by hand may have made it wrong."""
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(f"steps is {self.steps}; the inner registration needs a whole number, at least 1: try 20")
        if not self.damping >= 0:
            raise ValueError(f"damping is {self.damping}; it must not be negative: try {DAMPING}")

    def extra_repr(self) -> str:
        return f"steps={self.steps}" + (f", damping={self.damping}" if self.damping != DAMPING else "")


def solved(equations: Equations, damping: float) -> Tensor:
    """The step ``(batch, k)`` of damped normal equations; 0 where there is nothing to solve."""
    matrix = equations.matrix
    mean = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
    eye = torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
    safe = torch.where(mean > 0, matrix + damping * mean * eye, eye)
    return -torch.linalg.solve_ex(safe, equations.slope)[0]


def shortened(step: Tensor, d: int) -> Tensor:
    """The step, scaled down where its turn or shift is longer than a step may be."""
    k = rotation_dimensions(d)
    length = torch.maximum(step[:, :k].detach().norm(dim=-1), step[:, k:].detach().norm(dim=-1))
    return step * (LONGEST_STEP / length.clamp(min=LONGEST_STEP))[:, None]
