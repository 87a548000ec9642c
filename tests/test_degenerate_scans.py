"""Scans that fix less than a pose: copies of each other, as where a sensor stands still, and flat ones in space."""

import numpy as np
import pytest
import torch
from map_problems import some_edges, square_room

from bbr_layer import RigidMotion
from train.config import EdgeConfig
from train.edges import register_edges
from train.pose_graph import solve_pose_graph
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


@pytest.mark.parametrize("stored", [np.float64, np.float32])
def test_flat_scans_in_space_are_refused_as_nothing_holds_them_in_their_planes(stored):
    tilted = [np.column_stack((room, 0.05 * room[:, 0] + 0.3)) for room in map(square_room, 0.1 * np.eye(3)[:, :2])]
    with pytest.raises(ValueError, match=r"every scan is flat .* and they are mapped in the plane"):
        registered([scan.astype(stored).astype(np.float64) for scan in tilted])


def test_edges_that_say_nothing_of_a_pose_are_refused_in_a_sentence():
    edges, identity = some_edges(3), RigidMotion.identity(3, (5,))
    blind = edges._replace(information=torch.zeros(3, 6, 6, dtype=torch.float64), centre=edges.centre.double())
    moved = RigidMotion(edges.target_from_source.rotation, torch.ones(3, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match="no poses follow from the edges"):
        solve_pose_graph(blind._replace(target_from_source=moved), identity)
