"""How gradients reach the inputs through the inner registration: one small object each.

A mode answers, for each inner step of the whole layer, whether it is kept differentiable, and whether the loss is
differentiated as written or by its closed form.
"""

import warnings
from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Replay:
    """Assumes nothing: the exact gradient of all steps, from the clouds and a few numbers per step.

    The loss's gradient is a closed form; going backwards, each step asks for the derivative of that form along one
    direction (forward over reverse; Griewank and Walther, Evaluating Derivatives, 2008). Memory does not grow with
    steps x n x m. First derivatives only: ``Autograd`` has second ones.

    Parameters
    ----------
    last_steps: how many steps to go back, counted over all stages from the end; None: all. With a number it is
        ``Truncated``.

    Raises
    ------
    ValueError: fewer than one step.
    """

    closed_form: ClassVar[bool] = True
    last_steps: int | None = None

    def __post_init__(self) -> None:
        if self.last_steps is not None:
            _check_last_steps(self.last_steps)

    def attached(self, step: int, steps: int) -> bool:
        """True at every step, or at the last ``last_steps``."""
        return self.last_steps is None or step >= steps - self.last_steps


@dataclass(frozen=True)
class Autograd:
    """Assumes memory for every step: the plain differentiable unroll, exact, and differentiable again.

    Memory grows with steps x n x m for the soft losses. It is the oracle that every other mode is tested against.
    """

    closed_form: ClassVar[bool] = False

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

    closed_form: ClassVar[bool] = True
    last_steps: int = 20

    def __post_init__(self) -> None:
        _check_last_steps(self.last_steps)

    def attached(self, step: int, steps: int) -> bool:
        """True for the last ``last_steps`` of ``steps``."""
        return step >= steps - self.last_steps


@dataclass(frozen=True)
class Implicit:
    """Assumes convergence: the gradient of an optimum, from the last stage's loss at the final pose alone.

    By the implicit function theorem, the temperature held (Gould, Hartley and Campbell, Deep Declarative Networks,
    TPAMI 2022). Costs one Hessian of the pose's size, whatever the steps. Before convergence it is wrong: measured on
    softBD, another sign after 30 steps and 53 % off after 100. So it is guarded: the Hessian must be positive definite
    and a Newton step must move the cloud by less than a hundredth of the point spacing. No gradient flows to the start,
    to earlier stages or to learning rates.

    Parameters
    ----------
    damping: share of the Hessian's mean diagonal added to it. Default 0.
    on_unconverged: what the guard does: ``"replay"`` (default) takes the exact gradient of the steps instead,
        ``"warn"`` says so, ``"raise"`` refuses with a RuntimeError.

    Raises
    ------
    ValueError: a negative damping, or another word.
    """

    closed_form: ClassVar[bool] = True
    damping: float = 0.0
    on_unconverged: str = "replay"

    def __post_init__(self) -> None:
        if not self.damping >= 0:
            raise ValueError(f"damping is {self.damping}; it must not be negative: try 0 or 1e-3")
        if self.on_unconverged not in ("replay", "warn", "raise"):
            raise ValueError(f"on_unconverged is {self.on_unconverged!r}; it must be 'replay', 'warn' or 'raise'")

    def attached(self, step: int, steps: int) -> bool:
        """False at every step: the gradient comes from where they ended."""
        return False


@dataclass(frozen=True)
class Detached:
    """Assumes that the pose is a given: no gradient flows through the registration.

    The motion still differentiates in the points it is applied to.
    """

    closed_form: ClassVar[bool] = True

    def attached(self, step: int, steps: int) -> bool:
        """False at every step."""
        return False


Backward = Replay | Truncated | Implicit | Autograd | Detached


def _check_last_steps(last_steps: int) -> None:
    if last_steps < 1:
        raise ValueError(f"last_steps is {last_steps}; keep at least 1, or use Detached() to keep none")


def speak_up(mode: Implicit, doubt: str) -> None:
    """Warn, or refuse, as the mode has it.

    Raises
    ------
    RuntimeError: the mode refuses.
    """
    sentence = f"the implicit gradient is not to be trusted: {doubt}; give the layer more steps, or use Replay()"
    if mode.on_unconverged == "raise":
        raise RuntimeError(sentence)
    warnings.warn(sentence, stacklevel=2)
