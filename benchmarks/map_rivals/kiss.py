"""KISS-ICP (Vizzo et al., 2023), as pip installs it: scan to map, a constant velocity, its own adaptive gate.

Its numbers are made for a voxel of 1 m; so the scans come in units of the voxel, and all else stays at its default.
Planar scans are given with z = 0.
"""

import numpy as np

from benchmarks.map_rivals.chain import PLAIN, Solutions, in_own_unit, in_space, reach
from train.scans import Progress, ScanSet

# Beyond all ranges, voxels: no point of a scan is left out.
EVERYTHING = 1e6


def solved(scans: ScanSet, voxel: float, told: Progress) -> Solutions:
    """The one set of poses ``(k, 4, 4)`` at a voxel of so many reaches."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew, config.data.max_range = False, EVERYTHING
    config.mapping.voxel_size, config.registration.max_num_threads = 1.0, 1
    odometry, unit, poses = KissICP(config), voxel * reach(scans), []
    for number, points in enumerate(scans.points):
        odometry.register_frame(in_space(points) / unit, np.zeros(len(points)))
        poses.append(odometry.last_pose.copy())
        told("scans", number + 1, len(scans))
    yield PLAIN, in_own_unit(np.stack(poses), unit)
