"""DeepMapping (Ding & Feng, CVPR 2019): scans and starting poses in, corrected poses and losses out."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bbr_layer import RigidMotion
from models.free_space import sample_free_space
from models.occupancy import MNet
from models.scan_batch import Localisation, RegistrationTerm, ScanBatch


class MappingOutput(NamedTuple):
    """Answer of the mapper for one group of scans.

    Parameters
    ----------
    world_from_scan: corrected poses, ``(g, ...)`` float64.
    world_points: ``(g, n, d)`` scan points in the world; 0 where padded.
    losses: ``"occupancy"`` (nats), ``"registration"`` (in units of ``translation_scale``) and their weighted
        ``"total"``; scalars in float64.
    """

    world_from_scan: RigidMotion
    world_points: Float[Tensor, "g n d"]
    losses: dict[str, Tensor]


class DeepMapping(nn.Module):
    """Correct the poses of scans so that one occupancy map explains them all and neighbours agree.

    Parameters
    ----------
    localisation: L-Net, scan to correction, or ``FreePoses``, a correction per scan.
    occupancy: M-Net, place to logit.
    registration_term: how neighbouring scans are compared.
    free_samples: points of free space per ray. Default 3.
    occupancy_weight, registration_weight: of the two losses in the total, not negative. Defaults 0.1 and 0.9,
        DeepMapping's in 2D.
    translation_scale: length in the data's unit: a correction of 1 moves a scan by it, and registration
        losses count in it. A few point spacings to a tenth of a scan's range. Default 1.

    Raises
    ------
    ValueError: no free samples, a negative weight, a scale that is not positive.
    """

    def __init__(
        self,
        localisation: Localisation,
        occupancy: MNet,
        registration_term: RegistrationTerm,
        *,
        free_samples: int = 3,
        occupancy_weight: float = 0.1,
        registration_weight: float = 0.9,
        translation_scale: float = 1.0,
    ):
        super().__init__()
        if free_samples < 1:
            raise ValueError(f"free_samples is {free_samples}; the map needs free space too: try 3")
        for name, weight in (
            ("occupancy_weight", occupancy_weight),
            ("registration_weight", registration_weight),
        ):
            if not weight >= 0:
                raise ValueError(f"{name} is {weight}; a weight must not be negative: try 0 to leave the loss out")
        if not translation_scale > 0:
            raise ValueError(f"translation_scale is {translation_scale}; it is a length: try a few point spacings")
        self.localisation, self.occupancy, self.registration_term = localisation, occupancy, registration_term
        self.free_samples, self.translation_scale = free_samples, translation_scale
        self.occupancy_weight, self.registration_weight = occupancy_weight, registration_weight

    def set_progress(self, fraction: float) -> None:
        """Tell the registration term that ``fraction`` in [0, 1] of the training is done (it may anneal)."""
        self.registration_term.set_progress(fraction)

    def forward(self, batch: ScanBatch, generator: torch.Generator | None = None) -> MappingOutput:
        """Poses, world points and losses of one group; ``generator`` drives the free-space jitter."""
        batch = batch.without_padding()
        points, mask = batch.points, batch.mask
        correction = self.localisation.corrections(batch)
        world_from_scan = corrected_poses(batch, correction, self.translation_scale)
        world_points = torch.where(mask[..., None], world_from_scan(points), 0.0)
        world_free = world_from_scan(sample_free_space(points, mask, self.free_samples, generator))
        world_normals = None if batch.normals is None else world_from_scan.rotate(batch.normals)

        occupancy = balanced_occupancy_loss(self.occupancy(world_points), self.occupancy(world_free), mask)
        registration = self.registration_term(world_points, world_normals, mask, world_from_scan, batch)
        registration = registration / self.translation_scale
        total = self.occupancy_weight * occupancy + self.registration_weight * registration
        losses = {"occupancy": occupancy, "registration": registration, "total": total}
        return MappingOutput(world_from_scan, world_points, losses)


def corrected_poses(batch: ScanBatch, correction: Float[Tensor, "g k"], translation_scale: float) -> RigidMotion:
    """``R = exp(w) R0``, ``t = t0 + v * translation_scale`` for a correction (w, v); scan 0 stays.

    The scan turns about its own sensor: the translation does not depend on the rotation's correction, as it
    would in a chain of updates. A zero correction gives the starting pose to the last bit.
    """
    anchored = (batch.index == 0)[:, None]
    correction = torch.where(anchored, 0.0, correction.to(batch.start.translation.dtype))
    d = batch.points.shape[-1]
    rotvec, translation = correction[:, :-d], correction[:, -d:]
    turn = RigidMotion.from_rotvec(rotvec, torch.zeros_like(translation)).rotation
    return RigidMotion(turn @ batch.start.rotation, batch.start.translation + translation_scale * translation)


def balanced_occupancy_loss(
    hit_logits: Float[Tensor, "g n"], free_logits: Float[Tensor, "g k"], mask: Bool[Tensor, "g n"]
) -> Float[Tensor, ""]:
    """Binary cross-entropy, nats, with all hits together weighing as much as all free samples together.

    Parameters
    ----------
    hit_logits: ``(g, n)`` at the measured points.
    free_logits: ``(g, n * samples)`` along the rays, ray by ray.
    mask: ``(g, n)``, True where a point is real; its free samples count with it.
    """
    samples = free_logits.shape[1] // max(hit_logits.shape[1], 1)
    occupied = masked_mean(F.softplus(-hit_logits), mask)
    free = masked_mean(F.softplus(free_logits), mask.repeat_interleave(samples, dim=1))
    return (occupied + free) / 2


def masked_mean(values: Float[Tensor, "g n"], mask: Bool[Tensor, "g n"]) -> Float[Tensor, ""]:
    """Mean over the real entries in float64; 0 where there are none."""
    kept = torch.where(mask, values.double(), 0.0)
    return kept.sum() / mask.sum().clamp(min=1)
