"""A best-buddies loss between neighbouring scans, in the world, as the registration term of the mapper."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from bbr_layer import BuddyFilter, CloudPair, RigidMotion, SoftBBS, SoftBD, SoftBDNormals
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

# Distances are rounded off below this multiple of the point spacing, as in the layer's own default.
SMOOTHING = 0.2
# Point pairs compared at once. The graph of a soft loss holds about a dozen numbers per pair: 2^23 pairs in
# float32 take some 400 MiB. Larger batches are cut into pieces and computed again in the backward pass.
PAIRS_PER_PIECE = 2**23


class BuddyLoss(NamedTuple):
    """A loss of the paper with the temperatures it is annealed between.

    Parameters
    ----------
    build: makes the loss object.
    start: first temperature, in misalignments.
    end: last temperature, in point spacings.
    """

    build: Callable[[], nn.Module]
    start: float
    end: float


# softBBS, softBD and N end at one spacing (below it the soft buddies of noisy scans fall apart); F's
# temperature only rounds off its absolute value, at a third to a thirtieth of that, as in the layer's
# default second stage.
BUDDY_LOSSES: dict[str, BuddyLoss] = {
    "softBBS": BuddyLoss(lambda: SoftBBS(smoothing=SMOOTHING), 1.0, 1.0),
    "softBD": BuddyLoss(lambda: SoftBD(smoothing=SMOOTHING), 1.0, 1.0),
    "N": BuddyLoss(lambda: SoftBDNormals(smoothing=SMOOTHING), 1.0, 1.0),
    "F": BuddyLoss(lambda: BuddyFilter(), 0.3, 0.03),
}


class BuddyTerm(RegistrationTerm):
    """One of the paper's losses on every edge, cooled from the misalignment to the point spacing.

    The misalignment is the median nearest-neighbour distance of the moment, edge by edge. Hard buddies of
    misaligned scans are few and wrong, so the first temperatures let every point have many.

    Parameters
    ----------
    loss: ``"softBBS"``, ``"softBD"`` (default), ``"N"`` or ``"F"``.
    start: first temperature, in misalignments. None: the loss's own in ``BUDDY_LOSSES``.
    end: last temperature, in point spacings. None: the loss's own.

    Raises
    ------
    ValueError: an unknown loss; a start or end that is not positive.
    """

    def __init__(self, loss: str = "softBD", *, start: float | None = None, end: float | None = None):
        super().__init__()
        if loss not in BUDDY_LOSSES:
            raise ValueError(f"loss is {loss!r}; it must be one of {', '.join(BUDDY_LOSSES)}")
        row = BUDDY_LOSSES[loss]
        self.loss = row.build()
        self.cooling = checked_cooling(row.start if start is None else start, row.end if end is None else end)
        self.progress = 0.0

    def set_progress(self, fraction: float) -> None:
        self.progress = checked_progress(fraction)

    def forward(
        self,
        world_points: Float[Tensor, "g n d"],
        world_normals: Float[Tensor, "g n d"] | None,
        mask: Bool[Tensor, "g n"],
        world_from_scan: RigidMotion,
        batch: ScanBatch,
    ) -> Float[Tensor, ""]:
        clouds = edge_clouds(world_points, mask, batch)
        if not len(batch.edges):
            return clouds.target.sum(dtype=torch.float64)  # of nothing: 0, with a graph
        spacing = edge_spacing(batch)
        with torch.no_grad():
            distances = nearest_distances(clouds.target, clouds.source, clouds.source_mask)
        temperature = self.cooling.at(self.progress, misalignment(distances, clouds.target_mask), spacing)
        pair = _cloud_pair(clouds, spacing)
        if self.loss.needs_normals:
            if world_normals is None:
                world_normals = world_from_scan.rotate(batch.known_normals())
            normals = torch.where(mask[..., None], world_normals, 0.0)
            target, source = batch.edges.unbind(1)
            pair = pair._replace(P_normals=normals[target], Q_normals=normals[source])
        return edge_mean(self._as_lengths(self._in_pieces(pair, temperature), clouds, temperature), clouds.weight)

    def _in_pieces(self, pair: CloudPair, temperature: Tensor) -> Tensor:
        items, n, m = pair.P.shape[0], pair.P.shape[1], pair.Q.shape[1]
        size = max(PAIRS_PER_PIECE // max(n * m, 1), 1)
        if items <= size:
            return self.loss(pair, temperature)
        values = []
        for first in range(0, items, size):
            piece = CloudPair._make(None if field is None else field[first : first + size] for field in pair)
            heat = temperature[first : first + size]
            values.append(checkpoint(self.loss, piece, heat, use_reentrant=False, preserve_rng_state=False))
        return torch.cat(values)

    def _as_lengths(self, values: Tensor, clouds: EdgeClouds, temperature: Tensor) -> Tensor:
        if not isinstance(self.loss, SoftBBS):
            return values
        # A sum of buddies is a count: per possible pair, and in temperatures, it pulls like a distance.
        possible = torch.minimum(clouds.target_mask.sum(1), clouds.source_mask.sum(1)).clamp(min=1)
        return values * temperature / possible


def _cloud_pair(clouds: EdgeClouds, spacing: Tensor) -> CloudPair:
    return CloudPair(
        P=clouds.target,
        Q=clouds.source,
        P_mask=clouds.target_mask,
        Q_mask=clouds.source_mask,
        spacing=spacing,
    )
