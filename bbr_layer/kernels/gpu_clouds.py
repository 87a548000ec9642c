"""The clouds and numbers of a scene laid out as the sweeps in Triton read them, and the launching of a sweep."""

from typing import Any, NamedTuple

import torch
import triton
from torch import Tensor

from bbr_layer.kernels import gpu_pairs as layout
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms
from bbr_layer.pair import CloudPair

OWN, OTHER, CHANNELS = layout.OWN.value, layout.OTHER.value, layout.CHANNELS.value
POINT, NORMAL, WEIGHT, REAL = layout.POINT.value, layout.NORMAL.value, layout.WEIGHT.value, layout.REAL.value
VELOCITY, NORMAL_VELOCITY = layout.VELOCITY.value, layout.NORMAL_VELOCITY.value
# One for every row of a tile.
WARPS = 4


class Cloud(NamedTuple):
    """One cloud as the sweeps read it.

    Parameters
    ----------
    channels: ``(batch, CHANNELS, length)``, see ``gpu_pairs``.
    size: how many points there are before the padding to ``length``.
    """

    channels: Tensor
    size: int

    def channel(self, which: int) -> Tensor:
        """One channel of the points, ``(batch, size)``, in float64."""
        return self.channels[:, which, : self.size].double()

    def put(self, first: int, values: Tensor) -> None:
        """Set a channel to ``(batch, size)`` values, or as many as there are in ``(batch, size, d)``."""
        values = values[..., None] if values.ndim == 2 else values
        self.channels[:, first : first + values.shape[-1], : self.size] = values.mT


def clouds_of(terms: SoftTerms, pair: CloudPair, direction: Direction | None) -> tuple[Cloud, Cloud]:
    """The target, which rests, and the source."""
    P = _cloud(pair.P, pair.P_weights)
    Q = _cloud(pair.Q, pair.Q_weights)
    if terms.planes:
        for cloud, normals in zip((P, Q), pair.both_normals(), strict=True):
            cloud.put(NORMAL, normals)
    if direction is not None:
        Q.put(VELOCITY, direction.Q)
        if direction.Q_normals is not None:
            Q.put(NORMAL_VELOCITY, direction.Q_normals)
    for cloud, mask in ((P, pair.P_mask), (Q, pair.Q_mask)):
        if mask is not None:  # all channels: whatever a padded point holds, NaN included, reaches nothing
            cloud.channels[..., : cloud.size].masked_fill_(~mask[:, None], 0.0)
    return P, Q


def _cloud(points: Tensor, weights: Tensor | None) -> Cloud:
    batch, size = points.shape[:2]
    cloud = Cloud(points.new_zeros(batch, CHANNELS, triton.cdiv(size, OTHER) * OTHER), size)
    cloud.put(POINT, points)
    cloud.channels[:, REAL, :size] = 1.0
    cloud.put(WEIGHT, points.new_ones(batch, size) if weights is None else weights)
    return cloud


def numbers_of(terms: SoftTerms, scene: Scene, direction: Direction | None, clouds: tuple[Cloud, Cloud]) -> Tensor:
    """The numbers of every item, for P's turn and for Q's, ``(2, batch, NUMBERS)``; those of the loss still 0."""
    alpha = scene.temperature.double()
    numbers = alpha.new_zeros(2, *alpha.shape, layout.NUMBERS.value)
    for turn in range(2):
        numbers[turn, :, layout.OWN_LENGTH.value] = clouds[turn].channels.shape[-1]
        numbers[turn, :, layout.OTHER_LENGTH.value] = clouds[1 - turn].channels.shape[-1]
    numbers[..., layout.SMOOTH.value] = scene.rounding.double().square()
    numbers[..., layout.COOL.value] = 1 / alpha
    numbers[..., layout.ALIGN.value] = float(terms.align_signs)
    if direction is not None:
        numbers[..., layout.COOL_RATE.value] = direction.temperature / alpha
    return numbers


def swept(sweep: Any, clouds: tuple[Cloud, Cloud], numbers: Tensor, sums: int, kind: int) -> tuple[Tensor, Tensor]:
    """What ``sweep`` sums up for the points of P and of Q, ``(batch, sums, size)`` float64.

    ``kind`` is what to compile for, see ``gpu_pairs``.
    """
    answers = []
    for turn in range(2):
        own, other = clouds[turn], clouds[1 - turn]
        batch, _, length = own.channels.shape
        out = numbers.new_empty(batch, sums, length)
        grid = (triton.cdiv(own.size, OWN), batch)
        with torch.cuda.device_of(out):  # Triton launches on the current device, whatever holds the tensors
            # Multiply and add in one where the processor can: Triton's default, which it has announced to change.
            options = {"num_warps": WARPS, "enable_fp_fusion": True}
            sweep[grid](own.channels, other.channels, numbers[turn], out, kind, **options)
        answers.append(out[..., : own.size])
    return answers[0], answers[1]
