"""The derivative of a closed-form gradient along a direction, by dual numbers."""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bbr_layer.kernels.scene import Direction, Scene
from bbr_layer.pair import CloudPair


def along(gradient: Callable[[Scene], Scene], scene: Scene, direction: Direction) -> tuple[Scene, Scene]:
    """``gradient(scene)`` and its derivative as the source, its normals and the temperature change by ``direction``."""
    moving = [name for name in ("Q", "Q_normals") if getattr(direction, name) is not None]
    primals = (scene.temperature, *(getattr(scene.pair, name) for name in moving))
    tangents = (direction.temperature, *(getattr(direction, name) for name in moving))
    present: list[bool] = []
    answer = torch.func.jvp(partial(_flat, gradient, scene, moving, present), primals, tangents)
    return _scene(answer[0], present), _scene(answer[1], present)


def _flat(
    gradient: Callable[[Scene], Scene], scene: Scene, moving: list[str], present: list[bool], *values: Tensor
) -> tuple[Tensor, ...]:
    """The gradient as tensors alone; which fields of the pair they are is left in ``present``."""
    pair = scene.pair._replace(**dict(zip(moving, values[1:], strict=True)))
    answer = gradient(Scene(pair, values[0], scene.rounding))
    present[:] = [field is not None for field in answer.pair]
    return answer.temperature, answer.rounding, *(field for field in answer.pair if field is not None)


def _scene(parts: tuple[Tensor, ...], present: list[bool]) -> Scene:
    fields = iter(parts[2:])
    return Scene(CloudPair._make(next(fields) if here else None for here in present), parts[0], parts[1])
