"""Scans made ready for registration: normals from the full scan, then thinned to one size."""

from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer import estimate_normals, evenly_thinned
from train.scans import ScanSet

# Normals are fitted to so many neighbours of the full scan before it is thinned: a line in the plane. In space the
# paper's 13, which reach along one ring of a dense lidar and not to the next (the paper takes 94 there): one per so
# many points, up to 30, with which kitti00 and tum of benchmarks/mapping_table.md come nearer.
PLANAR_NEIGHBOURS = 6
FEWEST_NEIGHBOURS, POINTS_PER_NEIGHBOUR, MOST_NEIGHBOURS = 13, 500, 30


class Prepared(NamedTuple):
    """Scans thinned to one size, padded: ``(k, n, d)`` points and normals float32, ``(k, n)`` mask."""

    points: Tensor
    normals: Tensor
    mask: Tensor


def prepare(scans: ScanSet, most: int) -> Prepared:
    """Normals from the full scans, then at most ``most`` points of each, spread evenly in space."""
    chosen, normals = [], []
    for scan in scans.points:
        points = torch.from_numpy(scan)
        kept = torch.from_numpy(evenly_thinned(scan, most))
        chosen.append(points[kept])
        normals.append(estimate_normals(points, _neighbours(points))[kept])
    return _padded(chosen, normals)


def _neighbours(points: Tensor) -> int:
    if points.shape[1] == 2:
        return PLANAR_NEIGHBOURS
    return min(max(FEWEST_NEIGHBOURS, len(points) // POINTS_PER_NEIGHBOUR), MOST_NEIGHBOURS)


def thinned(prepared: Prepared, most: int) -> Prepared:
    """At most ``most`` of the points of each scan, even in space."""
    chosen, normals = [], []
    for points, directions, mask in zip(*prepared, strict=True):
        kept = torch.from_numpy(evenly_thinned(points[mask].double().numpy(), most))
        chosen.append(points[mask][kept])
        normals.append(directions[mask][kept])
    return _padded(chosen, normals)


def _padded(chosen: list[Tensor], normals: list[Tensor]) -> Prepared:
    sizes = torch.tensor([len(points) for points in chosen])
    points, directions = (torch.nn.utils.rnn.pad_sequence(x, batch_first=True).float() for x in (chosen, normals))
    return Prepared(points, directions, torch.arange(int(sizes.max())) < sizes[:, None])
