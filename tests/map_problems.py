"""Small finished maps with known answers, for the tests of what a run leaves behind."""

import numpy as np
import torch

from bbr_layer import RigidMotion
from train.outputs import MapResult
from train.pose_graph import Edges
from train.scans import ScanSet

SETTINGS = {"seed": 3, "training": {"term": "F", "rates": [1e-4, 0.003]}, "note": "größer", "start": None}


def square_room(position: np.ndarray, beams: int = 180) -> np.ndarray:
    """What a sensor at ``position`` sees of a room with walls at +-2, along the world's axes."""
    angles = np.linspace(0, 2 * np.pi, beams, endpoint=False) + 1e-3
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    return directions * np.min((np.sign(directions) * 2 - position) / directions, axis=1)[:, None]


def room_result(d: int = 2, k: int = 5, error: float = 0.01) -> MapResult:
    """k scans of a room from places on an arc; the estimate is off by ``error``."""
    angles = np.linspace(0, 2, k)
    truth = np.tile(np.eye(d + 1), (k, 1, 1))
    truth[:, :2, d] = 0.8 * np.stack((np.cos(angles), np.sin(angles)), axis=1)
    scans = [square_room(pose[:2, d]) for pose in truth]
    if d == 3:
        levels = (0.0, 0.05, 1.0)
        scans = [np.concatenate([np.insert(scan, 2, height, axis=1) for height in levels]) for scan in scans]
    estimate = truth.copy()
    estimate[:, :d, d] += error * np.random.default_rng(0).normal(size=(k, d))
    names, timestamps = [f"scan {i}" for i in range(k)], 100 + 0.1 * np.arange(k)
    return MapResult(ScanSet(scans, names, timestamps, truth=truth), estimate, settings=SETTINGS, unit="m")


def some_edges(d: int) -> Edges:
    target, source, kind = torch.tensor([0, 1, 0]), torch.tensor([1, 2, 4]), torch.tensor([0, 0, 2], dtype=torch.int8)
    size = d * (d + 1) // 2
    information, centre = torch.eye(size).expand(3, size, size), torch.zeros(3, d)
    return Edges(target, source, RigidMotion.identity(d, (3,)), information, centre, torch.ones(3), kind)
