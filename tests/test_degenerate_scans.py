"""Scans that fix less than a pose: copies of each other, as where a sensor stands still."""

import numpy as np
import pytest
from map_problems import square_room

from train.config import EdgeConfig
from train.edges import register_edges
from train.scans import ScanSet


def registered(points):
    """Poses of the scans ``(k, d + 1, d + 1)``."""
    names, times = [str(number) for number in range(len(points))], np.arange(len(points), dtype=float)
    return register_edges(ScanSet(points, names, times), EdgeConfig(points=180))[1].matrix.numpy()


@pytest.mark.parametrize("d", [2, 3])
def test_copies_of_a_scan_stay_where_they_are(d, rng):
    scan = square_room(np.array([0.3, -0.2])) if d == 2 else rng.normal(size=(200, 3))
    np.testing.assert_allclose(registered([scan] * 3), np.tile(np.eye(d + 1), (3, 1, 1)), atol=1e-9)


def test_a_sensor_that_stands_still_to_the_last_bit_and_then_moves_is_mapped():
    places = np.array([[0.0, 0.0]] * 4 + [[0.3, 0.1], [0.6, 0.2]])
    poses = registered([square_room(place) for place in places])
    np.testing.assert_allclose(poses[:, :2, 2], places, atol=0.02)
