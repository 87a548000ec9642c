"""What every kernel reads and answers.

A soft loss is a function of S = sum B and M = sum B D, where B are the soft buddies of Eq. 4 and D the distances:
softBBS is -S (Eq. 5), softBD and N are M / S (Eq. 6). Its gradient needs three sweeps over the n x m pairs, of which
nothing but row and column sums is kept (compiled, a step also keeps exponentials and distances of up to 2^20 pairs from
its first sweep for the other two); the derivative of that gradient along a direction needs the same three in dual
numbers.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.pair import CloudPair


class SoftTerms(NamedTuple):
    """Which soft loss.

    Parameters
    ----------
    mean: M / S (Eq. 6) instead of -S (Eq. 5).
    planes: D is Eq. 7 instead of the Euclidean distance.
    align_signs: with ``planes``, turn normals to one side first.
    outlier: the epsilon of Eq. 4.
    match: what buddies are found by, ``"points"`` (D itself), ``"features"`` or ``"both"``.
    feature_weight: length per unit of feature distance.
    clip: distances are cut at this many standard deviations of their squares above the mean; None: not at all.
    """

    mean: bool
    planes: bool = False
    align_signs: bool = True
    outlier: float = 0.0
    match: str = "points"
    feature_weight: float = 1.0
    clip: float | None = None


class Scene(NamedTuple):
    """A pair of clouds with the source already moved, and the two lengths of a loss; or a gradient by all of these.

    Parameters
    ----------
    pair: the clouds; of a gradient, the derivatives by its fields (masks and spacing None).
    temperature: ``(batch,)`` float64.
    rounding: ``(batch,)`` float64, length below which distances are rounded off.
    """

    pair: CloudPair
    temperature: Tensor
    rounding: Tensor


class Direction(NamedTuple):
    """How the moved source, its normals and the temperature change: ``(batch, m, d)`` twice (or None), ``(batch,)``."""

    Q: Tensor
    Q_normals: Tensor | None
    temperature: Tensor


@runtime_checkable
class Kernel(Protocol):
    """Loss, gradient and directional derivative of one loss on one pair of clouds."""

    def gradient(self, scene: Scene, motion: RigidMotion) -> tuple[Tensor, Scene]:
        """Loss ``(batch,)`` float64 and its gradient by everything in the scene, whose source ``motion`` has moved."""

    def directional(self, scene: Scene, motion: RigidMotion, direction: Direction) -> tuple[Scene, Scene]:
        """The gradient, and its derivative along ``direction``."""


def loss_of_sums(terms: SoftTerms, S: Tensor, M: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The loss and its derivatives by S and by M, ``(batch,)`` each; without any buddy a mean is 0 and stays so."""
    if not terms.mean:
        return -S, -torch.ones_like(S), torch.zeros_like(S)
    present = S > 0
    inverse = torch.where(present, 1 / torch.where(present, S, 1.0), 0.0)
    loss = M * inverse
    return loss, -loss * inverse, inverse
