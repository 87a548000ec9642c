"""All stages of a registration, each from where the last one ended."""

from functools import partial

from bbr_layer.backward import Backward
from bbr_layer.geometry import RigidMotion
from bbr_layer.pair import CloudPair, Frame
from bbr_layer.registration import StageResult
from bbr_layer.stage import Stage


def descended(stages: list[Stage], clouds: tuple[CloudPair, Frame], motion: RigidMotion, mode: Backward) -> StageResult:
    """Where the last of ``stages`` ended, at least one.

    Parameters
    ----------
    clouds: the centred pair and its frame.
    motion: where to begin, between the user's frames.
    mode: which steps keep a graph, counted over all stages.
    """
    steps, done = inner_steps(stages), 0
    for stage in stages:
        attached, last = partial(_attached, mode, done, steps), stage is stages[-1]
        ended = stage(*clouds, motion, attached, closed_form=mode.closed_form, last=last)
        motion, done = ended.motion, done + stage.inner.steps
    return ended


def inner_steps(stages: list[Stage]) -> int:
    """How many steps all of them take."""
    return sum(stage.inner.steps for stage in stages)


def _attached(mode: Backward, done: int, steps: int, step: int) -> bool:
    """Whether ``step`` of a stage that begins after ``done`` of all ``steps`` is kept differentiable."""
    return mode.attached(done + step, steps)
