"""A small simulated world as the mapper reads it, with edges that need no registration."""

import dataclasses
import functools

import numpy as np
import torch

from bbr_layer import RigidMotion
from train.config import MapConfig
from train.known_edges import neighbouring
from train.pose_graph import Edges
from train.scans import ScanSet, planar_poses
from train.simulate import WorldSettings, simulate

SCANS, BEAMS = 8, 64


@functools.cache
def small_world(dimension: int = 2) -> ScanSet:
    """Eight scans, with their truth and no starting poses; the world begins at the first scan."""
    return world_of(WorldSettings(dimension=dimension, scans=SCANS, beams=BEAMS, rings=8))


def world_of(settings: WorldSettings) -> ScanSet:
    """The scans of a simulated world, which begins at the first of them."""
    world = simulate(settings)
    truth = np.linalg.inv(world.world_from_scan[0]) @ world.world_from_scan
    if settings.dimension == 2:
        truth = planar_poses(truth, "truth")
    return ScanSet(world.points, [f"{number}.ply" for number in range(len(truth))], world.timestamps, truth=truth)


def small_config(**training: object) -> MapConfig:
    """Two epochs of small steps, apart from what is given."""
    return MapConfig.model_validate({"training": {"epochs": 2, "points": 64, "group": 4, **training}})


def true_poses(scans: ScanSet) -> RigidMotion:
    """``world_from_scan`` as it was."""
    assert scans.truth is not None
    return RigidMotion.from_matrix(torch.tensor(scans.truth))


def displaced(poses: RigidMotion, metres: float) -> RigidMotion:
    """All poses but the first off by normal noise."""
    shift = metres * torch.randn(poses.translation.shape, dtype=torch.float64)
    shift[0] = 0
    return RigidMotion(poses.rotation, poses.translation + shift)


def true_edges(scans: ScanSet) -> Edges:
    """Window edges whose measurements are the truth."""
    return neighbouring(scans, true_poses(scans), small_config().edges)


def with_start(scans: ScanSet, poses: RigidMotion) -> ScanSet:
    """The same scans with given poses."""
    return dataclasses.replace(scans, start=poses.matrix.numpy())
