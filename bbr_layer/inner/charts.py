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

    def slope(self, state: State, frame: Frame, by_motion: RigidMotion) -> Tensor:
        """A derivative by the motion, ``(batch, d, d)`` and ``(batch, d)``, as one by the tangent at 0."""
        return torch.cat((_torque(by_motion.rotation, state.turn), by_motion.translation), -1)

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

    def slope(self, state: State, frame: Frame, by_motion: RigidMotion) -> Tensor:
        """A derivative by the motion, ``(batch, d, d)`` and ``(batch, d)``, as one by the tangent at 0."""
        shift = by_motion.translation / frame.scale[:, None]
        turn = by_motion.rotation + shift[:, :, None] * frame.source_centre[:, None, :]
        torque = _torque(turn, rotation_from_euler(state.turn))
        if state.turn.shape[-1] == 3:
            torque = (_euler_axes(state.turn) * torque[:, None]).sum(-1)
        return torch.cat((torque, shift), -1)

    def __repr__(self) -> str:
        return "EulerAngles()"


def _torque(by_rotation: Tensor, rotation: Tensor) -> Tensor:
    """The derivative by w at 0 of what has ``by_rotation`` by R, where R becomes ``exp(w) R``, ``(batch, k)``."""
    turned = by_rotation @ rotation.mT
    twist = turned - turned.mT
    if rotation.shape[-1] == 2:
        return twist[:, 1, :1]
    return torch.stack((twist[:, 2, 1], twist[:, 0, 2], twist[:, 1, 0]), -1)


def _euler_axes(angles: Tensor) -> Tensor:
    """Rows: the axes in space about which ``Rz Ry Rx`` turns as the angles about x, y and z grow, ``(batch, 3, 3)``."""
    _, y, z = angles.unbind(-1)
    zero, one = torch.zeros_like(y), torch.ones_like(y)
    about_x = torch.stack((z.cos() * y.cos(), z.sin() * y.cos(), -y.sin()), -1)
    about_y = torch.stack((-z.sin(), z.cos(), zero), -1)
    return torch.stack((about_x, about_y, torch.stack((zero, zero, one), -1)), -2)


Chart = RotationVector | EulerAngles
