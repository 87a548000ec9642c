"""How gradients reach the inputs through the inner registration: one small object each.

A mode answers, for each inner step of the whole layer, whether it is kept differentiable.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Autograd:
    """Assumes memory for every step: the plain differentiable unroll, exact, and differentiable again.

    Memory grows with steps x n x m for the soft losses. It is the oracle that every other mode is tested against.
    """

    def attached(self, step: int, steps: int) -> bool:
        """True at every step."""
        return True


@dataclass(frozen=True)
class Truncated:
    """Assumes that early steps only bring the pose near: differentiates through the last ``last_steps`` alone.

    The answer is the exact gradient of the last steps from a fixed pose (Shaban et al., Truncated Back-propagation
    for Bilevel Optimization, AISTATS 2019). Measured on softBD: cosine 0.99 to the full gradient with 20 steps, 0.66
    with one.

    Parameters
    ----------
    last_steps: how many, counted over all stages from the end. At least 1.

    Raises
    ------
    ValueError: fewer than one step.
    """

    last_steps: int = 20

    def __post_init__(self) -> None:
        if self.last_steps < 1:
            raise ValueError(f"last_steps is {self.last_steps}; keep at least 1, or use Detached() to keep none")

    def attached(self, step: int, steps: int) -> bool:
        """True for the last ``last_steps`` of ``steps``."""
        return step >= steps - self.last_steps


@dataclass(frozen=True)
class Detached:
    """Assumes that the pose is a given: no gradient flows through the registration.

    The motion still differentiates in the points it is applied to.
    """

    def attached(self, step: int, steps: int) -> bool:
        """False at every step."""
        return False


Backward = Autograd | Truncated | Detached
