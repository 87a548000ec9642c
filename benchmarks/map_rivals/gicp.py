"""small_gicp (Koide, 2024), scan to scan: GICP or point-to-plane, first with a wide gate, then with a narrow one.

Planar scans are drawn out into a low wall of several rows, so that its normals, made for surfaces, lie in the plane.
"""

from typing import NamedTuple

import numpy as np
import small_gicp

from benchmarks.map_rivals.chain import (
    PLAIN,
    YAW,
    Solutions,
    along,
    chained,
    from_turned_starts,
    in_own_unit,
    in_reaches,
    in_space,
    reach,
)
from train.scans import Progress, ScanSet

# Neighbours of a normal: the library's default. Rows of a drawn out planar scan.
NEIGHBOURS, ROWS = 20, 4
# At most so many steps a run, and a step that counts as none, radians and reaches.
STEPS, TIGHT = 100, 1e-5


class Setting(NamedTuple):
    """The voxel and the farthest matches, run after run, in reaches; whether to begin at the last motion."""

    voxel: float
    gates: tuple[float, ...]
    follow: bool


# What is tried, row by row: from in place, from the last motion with wide gates, and coarse.
SETTINGS = (
    Setting(0.02, (0.5, 0.1), False),
    Setting(0.02, (1.0, 0.3, 0.1, 0.04), True),
    Setting(0.05, (2.0, 0.7, 0.2), False),
)


class SmallGicp:
    """Pairs of scans by ``kind``, ``GICP`` or ``PLANE_ICP``."""

    def __init__(self, scans: ScanSet, kind: str, setting: Setting) -> None:
        self.points, voxel = in_reaches(scans), setting.voxel
        self.kind, self.gates, self.tolerance = kind, setting.gates, voxel
        if scans.dimension == 2:
            clouds = [small_gicp.PointCloud(walled(points, voxel)) for points in self.points]
        else:
            clouds = [small_gicp.voxelgrid_sampling(points, voxel) for points in self.points]
        self.points = [in_space(points) for points in self.points]
        self.clouds, self.trees = clouds, [small_gicp.KdTree(cloud) for cloud in clouds]
        for cloud, tree in zip(clouds, self.trees, strict=True):
            small_gicp.estimate_normals_covariances(cloud, tree, NEIGHBOURS)

    def register(self, target: int, source: int, start: np.ndarray) -> np.ndarray:
        """``target_from_source (4, 4)``."""
        for gate in self.gates:
            found = small_gicp.align(
                self.clouds[target],
                self.clouds[source],
                self.trees[target],
                start,
                self.kind,
                max_correspondence_distance=gate,
                max_iterations=STEPS,
                rotation_epsilon=TIGHT,
                translation_epsilon=TIGHT,
            )
            start = np.asarray(found.T_target_source)
        return start


def walled(points: np.ndarray, spacing: float) -> np.ndarray:
    """Planar points ``(n, 2)`` repeated in rows above each other, ``(ROWS n, 3)``."""
    heights = spacing * (np.arange(ROWS) - (ROWS - 1) / 2)
    return np.concatenate([np.column_stack((points, np.full(len(points), height))) for height in heights])


def solved(scans: ScanSet, kind: str, setting: Setting, told: Progress) -> Solutions:
    """Poses ``(k, 4, 4)`` along the chain."""
    rival = SmallGicp(scans, kind, setting)
    motions = chained(rival, 4, setting.follow, told)
    yield PLAIN, in_own_unit(along(motions), reach(scans))
    yield YAW, in_own_unit(along(from_turned_starts(rival, motions, told)), reach(scans))
