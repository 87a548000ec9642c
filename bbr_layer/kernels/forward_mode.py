"""The derivative of a closed-form gradient along a direction, by dual numbers."""

from collections.abc import Callable

import torch
from torch import Tensor

from bbr_layer.kernels.scene import Direction, Scene
from bbr_layer.pair import CloudPair


def along(gradient: Callable[[Scene], Scene], scene: Scene, direction: Direction) -> tuple[Scene, Scene]:
    """``gradient(scene)`` and its derivative as the source, its normals and the temperature change by ``direction``."""
    moving = [name for name in ("Q", "Q_normals") if getattr(direction, name) is not None]
    present: list[bool] = []

    def flat(temperature: Tensor, *fields: Tensor) -> tuple[Tensor, ...]:
        pair = scene.pair._replace(**dict(zip(moving, fields, strict=True)))
        answer = gradient(Scene(pair, temperature, scene.rounding))
        present[:] = [field is not None for field in answer.pair]
        return answer.temperature, answer.rounding, *(field for field in answer.pair if field is not None)

    def scene_of(parts: tuple[Tensor, ...]) -> Scene:
        fields = iter(parts[2:])
        return Scene(CloudPair._make(next(fields) if here else None for here in present), parts[0], parts[1])

    primals = (scene.temperature, *(getattr(scene.pair, name) for name in moving))
    tangents = (direction.temperature, *(getattr(direction, name) for name in moving))
    answer = torch.func.jvp(flat, primals, tangents)
    return scene_of(answer[0]), scene_of(answer[1])
