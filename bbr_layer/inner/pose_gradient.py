"""The gradient of a loss by the pose as one node of the graph, whose backward is a directional derivative.

Reverse mode through an inner step needs ``v^T d g / d x`` for one vector v as small as the pose and every input x.
Second derivatives are symmetric, so this is the derivative along v of the full gradient: forward mode. Nothing of size
n x m outlives a sweep, and the node keeps the clouds, which all steps share, and the pose.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.scene import Direction, Kernel, Scene
from bbr_layer.once import once
from bbr_layer.pair import CloudPair

# The fields of a pair that a loss may depend on, in order; its masks and its spacing are held.
DIFFERENTIABLE = 8


class PoseSlope(NamedTuple):
    """Loss ``(batch,)`` and its derivatives by rotation matrix, translation and temperature; float64."""

    loss: Tensor
    rotation: Tensor
    translation: Tensor
    temperature: Tensor


class PairKernel(NamedTuple):
    """A loss in closed form, bound to a pair of clouds whose source is not yet moved.

    Parameters
    ----------
    kernel: the closed form.
    pair: the clouds.
    rounding: ``(batch,)`` float64, length below which distances are rounded off.
    """

    kernel: Kernel
    pair: CloudPair
    rounding: Tensor

    def slope(self, motion: RigidMotion, temperature: Tensor) -> PoseSlope:
        """Loss and slope with the source carried by ``motion``; once differentiable in everything."""
        return PoseSlope(*_Slope.apply(self.kernel, self.rounding, temperature, *motion, *self.pair))

    def detach(self) -> "PairKernel":
        """The same, cut from the graph."""
        return PairKernel(self.kernel, self.pair.detach(), self.rounding.detach())


class _Slope(torch.autograd.Function):
    @staticmethod
    def forward(kernel: Kernel, rounding: Tensor, temperature: Tensor, *rest: Any) -> tuple[Tensor, ...]:
        motion, pair = RigidMotion(*rest[:2]), CloudPair._make(rest[2:])
        loss, gradient = kernel.gradient(Scene(pair.moved_by(motion), temperature, rounding), motion)
        return loss, *_by_motion(gradient.pair, pair), gradient.temperature

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        ctx.kernel = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *cotangents: Tensor | None) -> tuple[Any, ...]:
        saved = ctx.saved_tensors  # read once: a checkpoint gives them once
        with torch.no_grad():
            found = _Slope.pulled_back(ctx.kernel, saved, cotangents)
        return None, *once(found, (*saved, *cotangents)), None, None, None

    @staticmethod
    def pulled_back(
        kernel: Kernel, saved: tuple[Any, ...], cotangents: tuple[Tensor | None, ...]
    ) -> tuple[Tensor | None, ...]:
        """Cotangents of rounding, temperature, motion and the differentiable fields of the pair."""
        rounding, temperature, *rest = saved
        motion, pair = RigidMotion(*rest[:2]), CloudPair._make(rest[2:])
        scene = Scene(pair.moved_by(motion), temperature, rounding)
        by_loss, rotation, translation, by_temperature = cotangents
        along = None
        if rotation is not None or translation is not None or by_temperature is not None:
            turn = torch.zeros_like(motion.rotation) if rotation is None else rotation
            shift = torch.zeros_like(motion.translation) if translation is None else translation
            along = RigidMotion(turn, shift)
            heat = torch.zeros_like(temperature) if by_temperature is None else by_temperature
            direction = Direction(along(pair.Q), _turned(along, pair.Q_normals), heat)
            gradient, total = kernel.directional(scene, motion, direction)
        else:
            _, gradient = kernel.gradient(scene, motion)
            total = _scaled(gradient, torch.zeros_like(temperature))
        if by_loss is not None:
            total = _sum(total, _scaled(gradient, by_loss))
        fields = _into_own_frame(total.pair, gradient.pair, motion, along)
        return total.rounding, total.temperature, *_by_motion(total.pair, pair), *fields


def _turned(along: RigidMotion, normals: Tensor | None) -> Tensor | None:
    return None if normals is None else along.rotate(normals)


def _by_motion(gradient: CloudPair, pair: CloudPair) -> tuple[Tensor, Tensor]:
    """Derivatives by the rotation matrix and the translation that moved the source."""
    rotation = gradient.Q.mT.double() @ pair.Q.double()
    if gradient.Q_normals is not None and pair.Q_normals is not None:
        rotation = rotation + gradient.Q_normals.mT.double() @ pair.Q_normals.double()
    return rotation, gradient.Q.sum(-2, dtype=torch.float64)


def _into_own_frame(
    total: CloudPair, gradient: CloudPair, motion: RigidMotion, along: RigidMotion | None
) -> list[Tensor | None]:
    """The cotangents of the pair's own fields: those of the moved source turned back, and the direction's own."""
    turned = {}
    for name in ("Q", "Q_normals"):
        moved, force = getattr(total, name), getattr(gradient, name)
        if moved is not None:
            own = moved.double() @ motion.rotation
            turned[name] = (own if along is None else own + force.double() @ along.rotation).to(moved.dtype)
    return list(total._replace(**turned))[:DIFFERENTIABLE]


def _scaled(scene: Scene, factor: Tensor) -> Scene:
    pair = CloudPair._make(_times(field, factor) for field in scene.pair)
    return Scene(pair, scene.temperature * factor, scene.rounding * factor)


def _times(values: Tensor | None, factor: Tensor) -> Tensor | None:
    return None if values is None else values * factor.reshape(-1, *[1] * (values.ndim - 1)).to(values.dtype)


def _sum(first: Scene, second: Scene) -> Scene:
    pair = CloudPair._make(
        None if a is None or b is None else a + b for a, b in zip(first.pair, second.pair, strict=True)
    )
    return Scene(pair, first.temperature + second.temperature, first.rounding + second.rounding)
