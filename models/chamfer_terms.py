"""The Chamfer distance between neighbouring scans, plain and with two robust controls."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bbr_layer import RigidMotion
from models.edge_clouds import (
    EdgeClouds,
    checked_cooling,
    checked_progress,
    edge_clouds,
    edge_spacing,
    misalignment,
    nearest_distances,
)
from models.scan_batch import RegistrationTerm, ScanBatch, edge_mean

# Kernel of the Geman-McClure control: from twice the misalignment of the moment to twice the point spacing,
# so that the typical neighbour is always inside it and an outlier soon is not.
KERNEL_START, KERNEL_END = 2.0, 2.0


class Chamfer(RegistrationTerm):
    """DeepMapping's: mean distance to the nearest neighbour, not squared, both ways added."""

    def forward(
        self,
        world_points: Float[Tensor, "g n d"],
        world_normals: Float[Tensor, "g n d"] | None,
        mask: Bool[Tensor, "g n"],
        world_from_scan: RigidMotion,
        batch: ScanBatch,
    ) -> Float[Tensor, ""]:
        clouds = edge_clouds(world_points, mask, batch)
        forth = nearest_distances(clouds.target, clouds.source, clouds.source_mask)
        back = nearest_distances(clouds.source, clouds.target, clouds.target_mask)
        return edge_mean(self.summed(forth, back, clouds, batch), clouds.weight)

    def summed(self, forth: Tensor, back: Tensor, clouds: EdgeClouds, batch: ScanBatch) -> Float[Tensor, "e"]:
        """One length per edge from the distances target to source and back, both ``(e, n)``."""
        return _mean(forth, clouds.target_mask) + _mean(back, clouds.source_mask)


class TrimmedChamfer(Chamfer):
    """Chamfer over the nearest share of the points of each cloud.

    Parameters
    ----------
    keep: the share, in (0, 1]. Default 0.7; at 1 it is ``Chamfer``.

    Raises
    ------
    ValueError: a share outside (0, 1].
    """

    def __init__(self, keep: float = 0.7):
        super().__init__()
        if not 0 < keep <= 1:
            raise ValueError(f"keep is {keep}; it is a share of the points in (0, 1]: try 0.7")
        self.keep = keep

    def summed(self, forth: Tensor, back: Tensor, clouds: EdgeClouds, batch: ScanBatch) -> Tensor:
        return self._trimmed(forth, clouds.target_mask) + self._trimmed(back, clouds.source_mask)

    def _trimmed(self, distances: Tensor, mask: Tensor) -> Tensor:
        ordered = torch.where(mask, distances, torch.inf).sort(-1).values
        kept = (self.keep * mask.sum(-1, keepdim=True)).ceil()
        return _mean(ordered, torch.arange(mask.shape[-1], device=mask.device) < kept)


class GemanMcClureChamfer(Chamfer):
    """Chamfer under the kernel ``s (r/s)^2 / (1 + (r/s)^2)``, whose length s is annealed.

    Parameters
    ----------
    start: first kernel length, in misalignments. None: 2.
    end: last kernel length, in point spacings. None: 2.

    Raises
    ------
    ValueError: a start or end that is not positive.
    """

    def __init__(self, *, start: float | None = None, end: float | None = None):
        super().__init__()
        self.cooling = checked_cooling(KERNEL_START if start is None else start, KERNEL_END if end is None else end)
        self.progress = 0.0

    def set_progress(self, fraction: float) -> None:
        self.progress = checked_progress(fraction)

    def summed(self, forth: Tensor, back: Tensor, clouds: EdgeClouds, batch: ScanBatch) -> Tensor:
        spacing = edge_spacing(batch)
        sides = ((forth, clouds.target_mask), (back, clouds.source_mask))
        return sum((self._robust(distances, mask, spacing) for distances, mask in sides), torch.zeros_like(spacing))

    def _robust(self, distances: Tensor, mask: Tensor, spacing: Tensor) -> Tensor:
        kernel = self.cooling.at(self.progress, misalignment(distances, mask), spacing)
        squared = (distances / kernel[:, None]).square()
        return kernel * _mean(squared / (1 + squared), mask)


def _mean(values: Float[Tensor, "e n"], mask: Bool[Tensor, "e n"]) -> Float[Tensor, "e"]:
    kept = torch.where(mask, values, 0.0).sum(-1, dtype=torch.float64)
    return kept / mask.sum(-1).clamp(min=1)
