"""Features of surfaces and the motion that their matches agree on: found from any turn, wrong matches outvoted."""

import numpy as np
import torch

from bbr_layer import RigidMotion
from train.consensus import consensus
from train.prepared import prepare
from train.scans import ScanSet
from train.shape_features import common_view, matched, shape_features
from train.surfaces import Surface, surfaces


def _hills(count: int, seed: int = 0) -> np.ndarray:
    """Points of a hilly ground, seen from above."""
    random = np.random.default_rng(seed)
    flat = random.uniform(-1, 1, size=(count, 2))
    tops, sizes = random.uniform(-0.8, 0.8, size=(6, 2)), random.uniform(0.1, 0.3, size=6)
    away = np.linalg.norm(flat[:, None] - tops, axis=2) / sizes
    return np.column_stack((flat, (sizes * np.exp(-(away**2))).sum(axis=1)))


def _scanned(clouds: list[np.ndarray], most: int = 2000) -> list[Surface]:
    return surfaces(prepare(ScanSet(clouds, ["a", "b"][: len(clouds)], np.arange(len(clouds), dtype=float)), most))


TURN = RigidMotion.from_rotvec(torch.tensor([0.4, -0.2, 2.0]).double(), torch.tensor([0.3, 0.1, -0.2]).double())


def test_two_samples_of_one_surface_are_found_from_far():
    cloud = _hills(2400)
    first, second = cloud[:1200], TURN.inverse()(torch.from_numpy(cloud[1200:])).numpy()
    scans = _scanned([first, second])
    spacing = scans[0].spacing
    # The ground was seen from far above: along its z axis, which the second scan has turned with it.
    features = [shape_features(scan, 6 * spacing, 3) for scan in scans]
    pairs = matched(features[0], features[1], 1000)
    ends = scans[0].points[pairs[:, 0]], scans[1].points[pairs[:, 1]]
    best = consensus(*ends, 2 * spacing, 2)[0]
    off = second @ best[:3, :3].T + best[:3, 3] - cloud[1200:]
    assert np.sqrt((off**2).sum(axis=1).mean()) < 2 * spacing


def test_consensus_outvotes_nine_wrong_matches_of_ten():
    random = np.random.default_rng(1)
    source = random.uniform(-1, 1, size=(300, 3))
    target = TURN(torch.from_numpy(source)).numpy()
    target[30:] = random.uniform(-1, 1, size=(270, 3))
    found = consensus(target, source, 0.01, 3)
    np.testing.assert_allclose(found[0], TURN.matrix.numpy(), atol=1e-6)
    assert len(found) <= 3


def test_where_scans_were_seen_from():
    ground = _hills(1500)
    assert common_view(_scanned([ground - [0, 0, -1.0], ground - [0, 0, 3.0]])) == 0
    # From the middle of the hills a sensor would see the far sides of many.
    assert common_view(_scanned([ground - [0, 0, 0.02]] * 2)) == 3
