"""How a pose is moved by a small step: the coordinates that the inner optimiser works in.

A chart begins at a motion, is moved by a tangent vector (rotation first, then translation), and tells the motion
between the centred clouds. The inner gradient is taken with respect to the tangent at 0.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.pair import Frame
from bbr_layer.rotations import euler_from_rotation, rotation_dimensions, rotation_from_euler, rotation_from_rotvec


class State(NamedTuple):
    """Where a chart is: ``turn`` is a rotation matrix ``(batch, d, d)`` or Euler angles ``(batch, k)``, by the chart.

    ``translation (batch, d)`` is in cloud radii about the centres, or in data units about the origin.
    """

    turn: Tensor
    translation: Tensor


class RotationVector:
    """Left-multiplied rotation vectors about the moved source's centre: ``R <- exp(w) R``.

    No direction is special, so a registration turns with the data; measured, it fails a third as often as Euler
    angles at 90 degrees.
    """

    scaled = True

    def begin(self, start: RigidMotion, frame: Frame) -> State:
        """The state of a motion between the user's frames."""
        return State(*frame.enter(start))

    def moved(self, state: State, tangent: Tensor) -> State:
        """The state after a step ``(batch, d (d + 1) / 2)``."""
        k = rotation_dimensions(state.translation.shape[-1])
        turn = rotation_from_rotvec(tangent[:, :k])
        return State(turn @ state.turn, state.translation + tangent[:, k:])

    def motion(self, state: State, frame: Frame) -> RigidMotion:
        """The motion between the centred and scaled clouds."""
        return RigidMotion(*state)

    def __repr__(self) -> str:
        return "RotationVector()"


class EulerAngles:
    """The paper's: ``R = Rz Ry Rx`` and ``t``, both about the origin of the data, in the data's unit."""

    scaled = False

    def begin(self, start: RigidMotion, frame: Frame) -> State:
        """The state of a motion between the user's frames."""
        return State(euler_from_rotation(start.rotation), start.translation)

    def moved(self, state: State, tangent: Tensor) -> State:
        """The state after a step: angles and translation are simply added to."""
        k = state.turn.shape[-1]
        return State(state.turn + tangent[:, :k], state.translation + tangent[:, k:])

    def motion(self, state: State, frame: Frame) -> RigidMotion:
        """The motion between the centred clouds."""
        return frame.enter(RigidMotion(rotation_from_euler(state.turn), state.translation))

    def __repr__(self) -> str:
        return "EulerAngles()"


Chart = RotationVector | EulerAngles


def tangent_zero(batch: int, d: int, device: torch.device) -> Tensor:
    """The tangent vector of no step, ``(batch, d (d + 1) / 2)`` float64."""
    return torch.zeros(batch, rotation_dimensions(d) + d, dtype=torch.float64, device=device)
