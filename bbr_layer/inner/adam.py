"""Adam (Kingma & Ba 2014) as a pure step, differentiable with respect to everything that enters it."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from bbr_layer.distances import smooth_root
from bbr_layer.inner.schedules import Constant, Cosine, Schedule, StepDown

Rate = float | Tensor


class Moments(NamedTuple):
    """Running means of the gradient and of its square, ``(batch, k)``, after ``step`` steps."""

    first: Tensor
    second: Tensor
    step: int

    @staticmethod
    def zero(like: Tensor) -> "Moments":
        """Before the first step."""
        return Moments(torch.zeros_like(like), torch.zeros_like(like), 0)

    def detach(self) -> "Moments":
        """The same numbers, cut from the graph."""
        return Moments(self.first.detach(), self.second.detach(), self.step)


def without_rounding(gradient: Tensor, noise: Tensor, size: int) -> Tensor:
    """The gradient ``(batch, k)``; its first ``size`` components 0, derivatives too, where no longer than the noise.

    At an exact optimum, where a pair and its exact copy begin, nothing is left of the gradient but the rounding of its
    sum, ``noise (batch,)``. Adam would take a whole step along it, with a derivative of one over it.
    """
    pose, rest = gradient.split((size, gradient.shape[-1] - size), dim=-1)
    heard = pose.detach().norm(dim=-1, keepdim=True) > noise[:, None]
    return torch.cat((torch.where(heard, pose, 0.0), rest), dim=-1)


def adam_direction(
    gradient: Tensor,
    moments: Moments,
    *,
    betas: tuple[float, float],
    eps: float,
    blocks: tuple[int, ...] | None = None,
) -> tuple[Tensor, Moments]:
    """One step of Adam at rate 1: the direction to subtract, ``(batch, k)``, and the new moments.

    The arithmetic is that of ``torch.optim.Adam``. At a second moment of 0 the direction has derivative 0, where
    plain differentiation gives NaN.

    Parameters
    ----------
    gradient: ``(batch, k)``.
    moments: of the same shape.
    betas, eps: Adam's constants.
    blocks: sizes of blocks of components that share their mean square, so that no axis is special; None for one
        mean square per component.
    """
    first = betas[0] * moments.first + (1 - betas[0]) * gradient
    square = gradient.square()
    if blocks is not None:
        parts = square.split(blocks, dim=-1)
        square = torch.cat([part.mean(-1, keepdim=True).expand_as(part) for part in parts], dim=-1)
    second = betas[1] * moments.second + (1 - betas[1]) * square
    step = moments.step + 1
    root = smooth_root(second) / (1 - betas[1] ** step) ** 0.5
    # Where no gradient has ever been seen the direction is 0, and so is its derivative; dividing by eps alone would
    # multiply every later derivative by 1e8.
    moving = second > 0
    direction = torch.where(moving, first, 0.0) / (1 - betas[0] ** step) / torch.where(moving, root + eps, 1.0)
    return direction, Moments(first, second, step)


class Adam(nn.Module):
    """Settings of the inner Adam; rates given as Parameters are learned by the outer training.

    Parameters
    ----------
    steps: how many. Default 60.
    rate: per step, for the rotation (radians) and, unless ``translation_rate`` is given, for the translation too, in
        cloud radii (data units for the paper's chart). Default 0.1. Measured, as the others.
    translation_rate, temperature_rate: default to ``rate``; the latter counts for a learned temperature only.
    schedule: how rates fall, ``Cosine()`` (default), ``Constant()`` or ``StepDown()``.
    betas, eps: Adam's constants, default 0.9, 0.999 and 1e-8.
    shared: rotation axes share one mean square, translation axes another. Default True: measured, per-axis mean
        squares fail three times as often at 90 degrees, and only shared ones turn with the data.
    keep: ``"last"`` (default) or ``"best"``, the pose of lowest loss, as the authors' code does. For F, whose pairs
        change, losses of different steps do not compare.

    Raises
    ------
    ValueError: fewer than one step, a rate that is not positive, or an unknown ``keep``.
    """

    def __init__(
        self,
        steps: int = 60,
        rate: Rate = 0.1,
        *,
        translation_rate: Rate | None = None,
        temperature_rate: Rate | None = None,
        schedule: Schedule | None = None,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        shared: bool = True,
        keep: str = "last",
    ):
        super().__init__()
        self.steps, self.rate, self.schedule = steps, rate, Cosine() if schedule is None else schedule
        self.translation_rate, self.temperature_rate = translation_rate, temperature_rate
        self.betas, self.eps, self.shared, self.keep = betas, eps, shared, keep
        self.check()

    def check(self) -> None:
        """Raises what the class does: outer training, or a setting changed by hand, may have made it wrong."""
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ValueError(f"steps is {self.steps}; the inner registration needs a whole number, at least 1: try 60")
        if self.keep not in ("last", "best"):
            raise ValueError(f"keep is {self.keep!r}; it must be 'last' or 'best'")
        for name in ("rate", "translation_rate", "temperature_rate"):
            value = getattr(self, name)
            if value is not None and not torch.as_tensor(value).gt(0).all():
                raise ValueError(f"{name} is {_plain(value)}; a learning rate must be positive: try 0.1")

    def rates(self, sizes: tuple[int, ...], like: Tensor, steps: Sequence[int]) -> Tensor:
        """Rates ``(steps, k)`` of rotation, translation and temperature in blocks of ``sizes`` at the steps given."""
        own = (self.rate, self.translation_rate, self.temperature_rate)[: len(sizes)]
        each = [torch.as_tensor(self.rate if r is None else r, dtype=like.dtype, device=like.device) for r in own]
        factors = torch.tensor([self.schedule.factor(step, self.steps) for step in steps], dtype=like.dtype)
        blocks = [r.expand(size) for r, size in zip(each, sizes, strict=True)]
        return factors.to(like.device)[:, None] * torch.cat(blocks)

    def extra_repr(self) -> str:
        shown = [f"steps={self.steps}", f"rate={_plain(self.rate)}"]
        for name in ("translation_rate", "temperature_rate"):
            value = getattr(self, name)
            shown += [] if value is None else [f"{name}={_plain(value)}"]
        shown.append(f"schedule={self.schedule!r}")
        shown += [] if self.shared else ["shared=False"]
        shown += [] if self.keep == "last" else [f"keep={self.keep!r}"]
        return ", ".join(shown)


def _plain(value: Rate) -> float | list[float]:
    return value.tolist() if isinstance(value, Tensor) else value


__all__ = ["Adam", "Constant", "Cosine", "Moments", "StepDown", "adam_direction", "without_rounding"]
