"""Which points contradict what other scans saw: a ray that went on beyond a point saw that nothing stood there."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from train.scans import ScanSet
from train.shape_features import common_view
from train.surfaces import Surface

# A ray saw through a point when it, and the others next to it, went on beyond by this share of their length: less may
# be a wall seen at a grazing angle.
BEYOND = 0.1
# Rays next to a direction, how far from it they may lie in gaps between neighbouring rays, and scans' rays that tell
# the gap.
RAYS, NEAR_GAPS, GAP_RAYS = 3, 4.0, 500
# A point agrees with another scan within this many point spacings of one of its points.
AGREES = 2.0
# A point is taken to have moved when more scans saw through it than found it, one doubt on each side.
PRIOR = 0.5


@dataclass(frozen=True)
class RangeView:
    """What one scan saw, by direction: ``tree`` of unit vectors, ``ranges``, and the ``gap`` between neighbours."""

    tree: cKDTree
    ranges: Float[np.ndarray, "n"]
    gap: float

    def looked_at(self, points: Float[np.ndarray, "m d"]) -> Bool[np.ndarray, "m"]:
        """Whether a ray ended in the direction of each of ``points``, given in its own frame, at whatever distance."""
        return self.tree.query(_directions(points))[0] < NEAR_GAPS * self.gap

    def saw_through(self, points: Float[np.ndarray, "m d"]) -> Bool[np.ndarray, "m"]:
        """Whether its rays went on beyond each of ``points``, given in its own frame."""
        rays = min(RAYS, len(self.ranges))
        apart, near = self.tree.query(_directions(points), k=list(range(1, rays + 1)))
        shortest = self.ranges[near].min(axis=1)
        return (apart[:, -1] < NEAR_GAPS * self.gap) & (np.linalg.norm(points, axis=1) < (1 - BEYOND) * shortest)


def _directions(points: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "m d"]:
    return points / np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-300)


def range_views(scans: ScanSet, thinned: Sequence[Surface]) -> list[RangeView | None]:
    """The view of each scan; None for all where the scans were not seen from their origin."""
    if common_view(thinned) != 0:
        return [None] * len(scans)
    return [_view(points) for points in scans.points]


def _view(points: Float[np.ndarray, "n d"]) -> RangeView:
    ranges = np.linalg.norm(points, axis=1)
    kept = ranges > 0
    tree = cKDTree(points[kept] / ranges[kept, None])
    asked = tree.data[:: max(1, tree.n // GAP_RAYS)]
    return RangeView(tree, ranges[kept], float(np.median(tree.query(asked, k=[2])[0])))


class PointEvidence(NamedTuple):
    """How many scans found each point of one scan where it is, and how many saw through it, ``(n,)`` each."""

    found: Float[np.ndarray, " n"]
    seen_through: Float[np.ndarray, " n"]

    @property
    def weight(self) -> Float[np.ndarray, " n"]:
        """How far each point is believed to stand still, in (0, 1]; 1 where nobody contradicts it."""
        return (self.found + PRIOR) / (self.found + self.seen_through + PRIOR)

    @property
    def moved(self) -> Bool[np.ndarray, " n"]:
        """Whether more scans saw through the point than found it."""
        return self.seen_through > self.found


def point_evidence(
    clouds: Sequence[Float[np.ndarray, "_ d"]],
    scans: tuple[Sequence[Surface], Sequence[RangeView | None]],
    edges: Int[np.ndarray, "e 2"],
    world_from_scan: Float[np.ndarray, "k d1 d1"],
) -> list[PointEvidence]:
    """What the partners of each scan, over all ``edges``, say of its points.

    Parameters
    ----------
    clouds: points of each scan that are asked about, in its own frame.
    scans: surfaces and views of the k scans.
    edges: pairs of scans that see the same place.
    world_from_scan: poses ``(k, d + 1, d + 1)``.
    """
    surfaces, views = scans
    found = [np.zeros(len(cloud)) for cloud in clouds]
    through = [np.zeros(len(cloud)) for cloud in clouds]
    for witness, asked in np.concatenate((edges, edges[:, ::-1])):
        view, surface = views[witness], surfaces[witness]
        if view is None:
            continue
        relative = np.linalg.inv(world_from_scan[witness]) @ world_from_scan[asked]
        placed = clouds[asked] @ relative[:-1, :-1].T + relative[:-1, -1]
        near = surface.tree.query(placed, distance_upper_bound=AGREES * surface.spacing)[0]
        agrees = np.isfinite(near)
        found[asked] += agrees
        through[asked] += view.saw_through(placed) & ~agrees
    return [PointEvidence(*counts) for counts in zip(found, through, strict=True)]
