"""The benchmark of voxels: its chain of small_gicp's pairs, and what it measures against what."""

import json

import numpy as np
import pytest

from benchmarks import voxels
from benchmarks.mapping_rows import METRES, Row
from train.poses import embed_poses
from train.scans import ScanSet

SHIFT = 0.05


def box(random: np.random.Generator) -> np.ndarray:
    """Points on the walls and the floor of a room of a few metres."""
    points = random.uniform(-2, 2, size=(6000, 3))
    wall = random.integers(3, size=6000)
    points[np.arange(6000), wall] = 2 * random.choice([-1, 1], size=6000)
    return points


@pytest.fixture
def scans() -> ScanSet:
    """Three scans of the room; the sensor moves along x by ``SHIFT`` each time."""
    truth = embed_poses(np.tile(np.eye(4), (3, 1, 1)))
    truth[:, 0, 3] = SHIFT * np.arange(3)
    points = box(np.random.default_rng(0))
    seen = [points[i::3] - pose[:3, 3] for i, pose in enumerate(truth)]
    return ScanSet(seen, list("abc"), np.arange(3.0), truth=truth)


@pytest.mark.parametrize("kind", voxels.KINDS)
def test_the_chain_finds_the_motion_from_a_start_nearby(scans, kind):
    points, poses = voxels.chained(scans, kind, 0.2, np.tile(np.eye(4), (3, 1, 1)))
    np.testing.assert_allclose(poses, scans.truth, atol=0.01)
    assert 500 < points < 2000
    assert voxels.chained(scans, kind, 0.5, scans.truth)[0] < points


def test_each_way_is_held_to_the_truth_and_to_our_default(scans, monkeypatch):
    """Ours is twice as long as the truth, the others are the truth."""
    long = scans.truth.copy()
    long[:, 0, 3] *= 2
    monkeypatch.setattr(voxels, "ROWS", {"row": Row(lambda: scans, 1.0, METRES)})
    monkeypatch.setattr(voxels, "ours", lambda _, most: (most, long))
    begun = []
    monkeypatch.setattr(voxels, "chained", lambda *given: (begun.append(given[-1]), (7, scans.truth))[1])
    found: dict = {}
    kept: list[str] = []
    voxels.measure("row", found, lambda: kept.append(json.dumps(found)))
    assert len(kept) == len(found) == len(voxels.POINTS) + len(voxels.KINDS) * len(voxels.VOXELS)
    off = SHIFT * np.sqrt(2 / 3)
    for way, one in found.items():
        assert (one["error"], one["apart"]) == pytest.approx((off, 0) if way.startswith("ours") else (0, off), abs=1e-9)
    np.testing.assert_array_equal(begun[0], long)
    voxels.measure("row", found, lambda: kept.append("again"))
    assert "again" not in kept


def test_the_table_marks_the_default():
    one = {"points": 10.0, "error": 0.01234, "apart": 0.0}
    text = voxels.table({voxels.CHOSEN[0]: {"ours 5000": one, "GICP 0.1": one}})
    assert f"| {voxels.CHOSEN[0]} | GICP | voxel 0.1 m | 10 | 0.0123 | 0.0000 |" in text
    assert "| ours | at most 5000 points (default) | 10 |" in text
