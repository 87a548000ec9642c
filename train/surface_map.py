"""All scans as one map: how thick its surfaces are, and the poses at which they are thinnest.

An edge compares two scans; here the points of all scans around a place are held against one plane, so that the noise
of all of them is averaged and far ends of a sequence agree where any scan sees both.
"""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from bbr_layer import RigidMotion
from train.data_module import PreparedScan, draw
from train.free_space_evidence import point_evidence, range_views
from train.planes import Placed, Planes, fitted, thinning_step
from train.refinement import moved
from train.scans import Progress, ScanSet, silent
from train.surfaces import Surface, spacing_of

# Most points of a scan in the map, evenly spread: with fewer, planes of large scans are so wide that the map is
# thinnest away from the truth.
MOST_POINTS = 5000
# A plane is fitted to the points within this many point spacings of one scan: with 3, movers bend the map.
REACH = 2.0
# Fewest points that make a plane, and the cosine between normals from which points lie on one side of one wall.
LEAST, SAME_SIDE = 5, 0.5
# Width of the kernel in medians of the distances, about 3 standard deviations of a Gaussian, and its floor in reaches.
WIDTH, FINEST = 4.5, 0.02
# Scans meet when they share this part of the smaller one's planes.
SHARED = 0.15
# Steps of the adjustment: it settles within about 6.
STEPS = 8
# Pairs of a plane and a point near it, some 200 bytes each: with more, planes are fitted around fewer points.
MOST_PAIRS = 1_000_000
# Weight of the thickness in the score. Pairs of scans prefer the poses that the edges found to the true ones; the
# thickness tells them apart, by less: at 10 both differences count.
THICKNESS_WEIGHT = 10.0


class SurfaceMap:
    """Points of all scans, of which those that rays of other scans went through weigh less.

    Parameters
    ----------
    scans, prepared: the k scans.
    world_from_scan: starting poses ``(k, d + 1, d + 1)``: they tell which scans meet and bear witness of what moved,
        and their map the kernel's width in ``thickness``.
    """

    def __init__(
        self,
        scans: ScanSet,
        prepared: Sequence[PreparedScan],
        world_from_scan: Float[np.ndarray, "k d1 d1"],
    ):
        self.points = _joined(prepared)
        first = np.flatnonzero(np.diff(self.points.owner)) + 1
        clouds, normals = (np.split(part, first) for part in self.points[:2])
        trees = [cKDTree(cloud) for cloud in clouds]
        found = [Surface(*one, spacing_of(one[2])) for one in zip(clouds, normals, trees, strict=True)]
        self.reach = REACH * float(np.median([surface.spacing for surface in found]))
        here = self.points.at(world_from_scan)
        counts = cKDTree(here.points).query_ball_point(here.points, self.reach, return_length=True)
        self.asked = slice(None, None, max(1, -(-int(counts.sum()) // MOST_PAIRS)))
        self.weight = np.ones(len(here.points))
        planes = self._planes(here, None)
        evidence = point_evidence(clouds, (found, range_views(scans, found)), self._met(planes), world_from_scan)
        self.weight = np.concatenate([one.weight for one in evidence])
        self.width = self._width(planes)

    def thickness(self, world_from_scan: Float[np.ndarray, "k d1 d1"]) -> float:
        """How far points lie off the map's surfaces, in [0, 1] (Geman and McClure's kernel); lower is better.

        A point that has no surface counts as half an outlier: else a map would be better for falling apart.
        """
        here = self.points.at(world_from_scan)
        planes = self._planes(here, self.width)
        squared = (planes.offset[:, 0] / self.width) ** 2
        asked = len(here.points[self.asked])
        belief = self.weight[planes.point]
        outliers, believed = (np.bincount(planes.plane, x) for x in (belief * squared / (1 + squared), belief))
        return float(((outliers / believed).sum() + (asked - len(believed)) / 2) / asked)

    def adjusted(
        self, world_from_scan: Float[np.ndarray, "k d1 d1"], progress: Progress = silent
    ) -> Float[np.ndarray, "k d1 d1"]:
        """Poses at which the surfaces of the map are thinnest, from poses near them; the first is kept.

        Gauss-Newton on all poses with the planes eliminated (Liu and Zhang, BALM: Bundle Adjustment for Lidar
        Mapping, RA-L 2021), found anew at every step; robust by iterated weights.
        """
        poses, width = world_from_scan, self.width
        for step in range(STEPS):
            progress("adjustment", step, STEPS)
            here = self.points.at(poses)
            planes = self._planes(here, width)
            if not len(planes.plane):
                return poses
            poses, width = moved(poses, thinning_step(planes, here, poses)), self._width(planes)
        progress("adjustment", STEPS, STEPS)
        return poses

    def _met(self, planes: Planes) -> Int[np.ndarray, "e 2"]:
        """Pairs of scans that share at least ``SHARED`` of the smaller one's planes."""
        k = int(self.points.owner[-1]) + 1
        near = np.unique(planes.plane * k + self.points.owner[planes.point])
        seen = csr_array((np.ones(len(near)), (near // k, near % k)), shape=(len(planes.axes), k))
        both = (seen.T @ seen).toarray()
        size = np.diagonal(both)
        return np.argwhere(np.triu(both > SHARED * np.minimum(size, size[:, None]), 1))

    def _width(self, planes: Planes) -> float:
        least = FINEST * self.reach
        return max(WIDTH * float(np.median(np.abs(planes.offset[:, 0]))), least) if len(planes.plane) else least

    def _planes(self, here: Placed, width: float | None) -> Planes:
        """The planes of the points ``here`` near every asked one of them, of one side of a wall."""
        asked, normals = here.points[self.asked], here.normals[self.asked]
        near = cKDTree(asked).sparse_distance_matrix(cKDTree(here.points), self.reach, output_type="ndarray")
        i, j = near["i"], near["j"]
        alike = (normals[i] * here.normals[j]).sum(axis=1) > SAME_SIDE
        kept = alike & (np.bincount(i[alike], minlength=len(asked)) >= LEAST)[i]
        i, j = i[kept], j[kept]
        # About the point that is asked, so that far-away maps lose no digits.
        return fitted(np.unique(i, return_inverse=True)[1], j, here.points[j] - asked[i], self.weight[j], width)


class MapScore:
    """What training may not worsen: how pairs of scans agree, and how thick the map is; lower is better.

    Parameters
    ----------
    alignment: score of the pairs, lower is better (``train.alignment``).
    surfaces: the map.
    """

    def __init__(self, alignment: Callable[[RigidMotion], float], surfaces: SurfaceMap):
        self.alignment, self.surfaces = alignment, surfaces

    def __call__(self, world_from_scan: RigidMotion) -> float:
        """Score of the poses ``(k, ...)``."""
        thickness = self.surfaces.thickness(world_from_scan.matrix.detach().double().cpu().numpy())
        return self.alignment(world_from_scan) + THICKNESS_WEIGHT * thickness

    def adjusted(self, world_from_scan: RigidMotion, progress: Progress = silent) -> RigidMotion:
        """The poses at which the map is thinnest, or the given ones where those score no worse."""
        start = world_from_scan.matrix.detach().double().cpu().numpy()
        found = RigidMotion.from_matrix(torch.from_numpy(self.surfaces.adjusted(start, progress)))
        return found if self(found) < self(world_from_scan) else world_from_scan


def _joined(prepared: Sequence[PreparedScan]) -> Placed:
    """At most ``MOST_POINTS`` of every scan, in its own frame, normals turned towards the sensor."""
    chosen = [draw(len(scan.points), MOST_POINTS, None) for scan in prepared]
    clouds = [scan.points.double().numpy()[some] for scan, some in zip(prepared, chosen, strict=True)]
    normals = [scan.normals.double().numpy()[some] for scan, some in zip(prepared, chosen, strict=True)]
    points, directions = np.concatenate(clouds), np.concatenate(normals)
    away = (points * directions).sum(axis=1, keepdims=True) > 0
    owner = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    return Placed(points, np.where(away, -directions, directions), owner)
