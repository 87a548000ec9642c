"""All stages of a registration, each from where the last one ended."""

import warnings
from functools import partial

import torch

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

    Warns
    -----
    UserWarning: features want a gradient, and the last stage does not see them.
    """
    _speak_of_features(stages[-1], clouds[0])
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


def _speak_of_features(last: Stage, pair: CloudPair) -> None:
    # A stage forgets where it began, and with it what the stages before it were told.
    wanted = any(x is not None and x.requires_grad for x in (pair.P_features, pair.Q_features))
    if torch.is_grad_enabled() and wanted and not last.loss.sees_features(pair):
        sentence = f"features want a gradient, but the layer ends with {last.loss!r}, which does not see them: it will "
        sentence += "be almost 0; to learn features end with a soft loss, try BBRLayer('softBD')"
        warnings.warn(sentence, stacklevel=2)
