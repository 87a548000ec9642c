"""How hot the soft buddies are: a schedule, or a number learned along with the pose.

A temperature object answers two questions about a registration of ``steps`` steps: the temperature at each step,
``(batch,)`` in the unit of the distances, and whether the inner optimiser may change it.
"""

import torch
from torch import Tensor, nn

# Temperatures never reach 0, where Eq. 4 divides by it: smallest value of the paper (its alpha_final).
TEMPERATURE_FLOOR = 1e-8


class Annealed(nn.Module):
    """Geometric cooling from ``start`` to ``end``, both in multiples of the point spacing; not learned.

    Parameters
    ----------
    start, end: positive multiples of the point spacing (Parameters or tensors stay differentiable). Defaults 2 and 1:
        measured; a hotter start flips 90 degree turns, an end of 0.5 lets the unrolled gradient explode.

    Raises
    ------
    ValueError: a start or end that is not positive.
    """

    learned = False

    def __init__(self, start: float | Tensor = 2.0, end: float | Tensor = 1.0):
        super().__init__()
        self.start, self.end = start, end
        self.check()

    def check(self) -> None:
        """Raises ValueError where a start or end is not positive: outer training may have taken it there."""
        _check_positive("start", self.start)
        _check_positive("end", self.end)

    def at(self, fraction: float | Tensor, spacing: Tensor) -> Tensor:
        """Temperature ``(batch,)`` when ``fraction`` in [0, 1] of the steps are done; of many ``(steps, 1)``, rows."""
        start, end = (torch.as_tensor(x, dtype=spacing.dtype, device=spacing.device) for x in (self.start, self.end))
        return spacing * start ** (1 - fraction) * end**fraction

    def initial(self, spacing: Tensor, scale: Tensor) -> Tensor:
        """Temperature before the first step; ``scale`` (data units per inner unit) plays no part."""
        return self.at(0.0, spacing)

    def floor(self, scale: Tensor) -> Tensor:
        """Smallest temperature ever used, ``(batch,)`` in inner units."""
        return TEMPERATURE_FLOOR / scale

    def extra_repr(self) -> str:
        return f"start={_number(self.start)}, end={_number(self.end)}"


class Learned(nn.Module):
    """The paper's temperature: a fixed start in the data's unit, then optimised together with the pose.

    Measured: learning brings nothing over ``Annealed`` or harms; it is here for the paper's sake, with the rates of
    ``BBRLayer.paper``. At the pose's own rate it falls to its floor at once, where no soft buddies are: give
    ``Adam(temperature_rate=...)`` far less.

    Parameters
    ----------
    start: alpha_init, in the data's unit. Default 1e-2, the paper's (metres of a 15 cm object).
    minimum: alpha_final, the floor. Default 1e-8, the paper's.

    Raises
    ------
    ValueError: a start or minimum that is not positive.
    """

    learned = True

    def __init__(self, start: float | Tensor = 1e-2, minimum: float = TEMPERATURE_FLOOR):
        super().__init__()
        self.start, self.minimum = start, minimum
        self.check()

    def check(self) -> None:
        """Raises ValueError where a start or minimum is not positive: outer training may have taken it there."""
        _check_positive("start", self.start)
        _check_positive("minimum", self.minimum)

    def at(self, fraction: float | Tensor, spacing: Tensor) -> Tensor:
        """Refused: a learned temperature follows no schedule."""
        raise ValueError("a learned temperature has no schedule; ask Annealed for one")

    def initial(self, spacing: Tensor, scale: Tensor) -> Tensor:
        """Temperature before the first step, ``(batch,)`` in inner units (data units over ``scale``)."""
        return torch.as_tensor(self.start, dtype=scale.dtype, device=scale.device) / scale

    def floor(self, scale: Tensor) -> Tensor:
        """Smallest temperature ever used, ``(batch,)`` in inner units."""
        return self.minimum / scale

    def extra_repr(self) -> str:
        return f"start={_number(self.start)}, minimum={self.minimum}"


class Unrounded(nn.Module):
    """Temperature 0 throughout: the plain absolute value of the paper's F. The soft losses cannot use it."""

    learned = False

    def check(self) -> None:
        """Nothing can be wrong."""

    def at(self, fraction: float | Tensor, spacing: Tensor) -> Tensor:
        """0 for every item, ``(batch,)``."""
        return torch.zeros_like(spacing)

    def initial(self, spacing: Tensor, scale: Tensor) -> Tensor:
        """0 for every item, ``(batch,)``."""
        return torch.zeros_like(spacing)

    def floor(self, scale: Tensor) -> Tensor:
        """0 for every item, ``(batch,)``."""
        return torch.zeros_like(scale)


Temperature = Annealed | Learned | Unrounded


def _check_positive(name: str, value: float | Tensor) -> None:
    if not torch.as_tensor(value).gt(0).all():
        raise ValueError(f"{name} is {_number(value)}; a temperature must be positive: try 1.0")


def _number(value: float | Tensor) -> float | str:
    if isinstance(value, nn.Parameter):
        return f"Parameter({value.tolist()})"
    return f"tensor({value.tolist()})" if isinstance(value, Tensor) else value
