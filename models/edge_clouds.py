"""The two clouds of every edge, their nearest neighbours, and the lengths that terms anneal between."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bbr_layer import RigidMotion
from models.scan_batch import ScanBatch

# Distances held at once while neighbours are searched: 2^23 float32 numbers are 32 MiB.
PAIRS_PER_TILE = 2**23


class EdgeClouds(NamedTuple):
    """Both ends of e edges, each edge about the centroid of its target (so that float32 keeps its digits).

    Parameters
    ----------
    target, source: ``(e, n, d)`` in the directions of the world; padded points are 0.
    target_mask, source_mask: ``(e, n)``, True where a point is real.
    weight: ``(e,)`` trust of the edge; 0 where one of its scans has no real point.
    """

    target: Float[Tensor, "e n d"]
    source: Float[Tensor, "e n d"]
    target_mask: Bool[Tensor, "e n"]
    source_mask: Bool[Tensor, "e n"]
    weight: Float[Tensor, "e"]


def edge_clouds(world_points: Float[Tensor, "g n d"], mask: Bool[Tensor, "g n"], batch: ScanBatch) -> EdgeClouds:
    """The clouds at both ends of each edge of the batch; differentiable in ``world_points``."""
    real = mask[..., None]
    points = torch.where(real, world_points, 0.0)
    count = mask.sum(1).clamp(min=1)[:, None].double()
    centroid = points.detach().sum(1, dtype=torch.float64) / count
    target, source = batch.edges.unbind(1)
    centre = centroid[target][:, None]
    ends = [torch.where(real[end], (points[end].double() - centre).to(points.dtype), 0.0) for end in (target, source)]
    both_real = mask[target].any(1) & mask[source].any(1)
    weight = torch.where(both_real, batch.edge_weight, 0.0)
    return EdgeClouds(ends[0], ends[1], mask[target], mask[source], weight)


def nearest_index(
    queries: Float[Tensor, "e n d"], candidates: Float[Tensor, "e m d"], mask: Bool[Tensor, "e m"]
) -> Int[Tensor, "e n"]:
    """Index of each query's nearest real candidate, ``(e, n)``; 0 where an item has none. No gradient."""
    queries, candidates = queries.detach(), candidates.detach()
    columns = max(candidates.shape[1], 1)
    rows = min(queries.shape[1], max(PAIRS_PER_TILE // columns, 1))
    items = max(PAIRS_PER_TILE // max(rows * columns, 1), 1)
    found = []
    for query, candidate, real in zip(queries.split(items), candidates.split(items), mask.split(items), strict=True):
        tiles = [_distances(tile, candidate, real).argmin(-1) for tile in query.split(max(rows, 1), dim=1)]
        found.append(torch.cat(tiles, dim=1))
    return torch.cat(found)


def _distances(queries: Tensor, candidates: Tensor, mask: Tensor) -> Tensor:
    # Explicit differences: the matrix-product form loses the small distances that decide who is nearest.
    distances = torch.cdist(queries, candidates, compute_mode="donot_use_mm_for_euclid_dist")
    return distances.masked_fill_(~mask[:, None, :], torch.inf)


def nearest_distances(
    queries: Float[Tensor, "e n d"], candidates: Float[Tensor, "e m d"], mask: Bool[Tensor, "e m"]
) -> Float[Tensor, "e n"]:
    """Distance from each query to its nearest real candidate, ``(e, n)``, differentiable in both ends."""
    index = nearest_index(queries, candidates, mask)
    nearest = candidates.gather(1, index[..., None].expand(-1, -1, candidates.shape[-1]))
    return safe_norm(queries - nearest)


def safe_norm(vectors: Float[Tensor, "*batch d"]) -> Float[Tensor, "*batch"]:
    """Length of each vector, with the derivative at length 0 defined as 0."""
    squared = vectors.square().sum(-1)
    positive = squared > 0
    return torch.where(positive, torch.where(positive, squared, 1.0).sqrt(), 0.0)


def misalignment(distances: Float[Tensor, "e n"], mask: Bool[Tensor, "e n"]) -> Float[Tensor, "e"]:
    """Median of nearest-neighbour distances, ``(e,)`` float64, without gradient; 0 where nothing is real."""
    median = torch.where(mask, distances.detach().double(), torch.nan).nanmedian(-1).values
    return median.nan_to_num(0.0)


def edge_spacing(batch: ScanBatch) -> Float[Tensor, "e"]:
    """Mean point spacing of the two scans of each edge, ``(e,)`` float64; 1 where both have spacing 0."""
    spacing = batch.known_spacing()[batch.edges].mean(1)
    return torch.where(spacing > 0, spacing, 1.0)


class Cooling(NamedTuple):
    """A length that falls geometrically from the misalignment of the moment to the point spacing.

    Parameters
    ----------
    start: first length, in misalignments.
    end: last length, in point spacings; never undercut.
    """

    start: float
    end: float

    def at(self, fraction: float, misaligned: Float[Tensor, "e"], spacing: Float[Tensor, "e"]) -> Float[Tensor, "e"]:
        """The length of each edge when ``fraction`` in [0, 1] of the training is done, ``(e,)`` float64."""
        last = self.end * spacing
        first = torch.maximum(self.start * misaligned, last)
        return first ** (1 - fraction) * last**fraction


def checked_cooling(start: float, end: float) -> Cooling:
    """A ``Cooling`` from positive numbers.

    Raises
    ------
    ValueError: a start or end that is not positive.
    """
    for name, value in (("start", start), ("end", end)):
        if not value > 0:
            raise ValueError(f"{name} is {value}; it multiplies a length and must be positive: try 1.0")
    return Cooling(start, end)


def checked_progress(fraction: float) -> float:
    """``fraction`` if it lies in [0, 1].

    Raises
    ------
    ValueError: outside [0, 1].
    """
    if not 0 <= fraction <= 1:
        raise ValueError(f"fraction is {fraction}; progress runs from 0 to 1: try epoch / epochs")
    return fraction


def relative_poses(world_from_scan: RigidMotion, batch: ScanBatch) -> RigidMotion:
    """``target_from_source`` of each edge as the poses have it, ``(e, ...)``."""
    target, source = batch.edges.unbind(1)
    return world_from_scan.between(target, source)
