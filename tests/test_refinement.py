"""All poses at once: exact where the scans are, wrong edges and contradicted points without harm."""

import numpy as np
import pytest
import torch
from small_worlds import displaced, small_world, true_poses

from train.prepared import prepare
from train.refinement import refine
from train.surfaces import surfaces

EDGES = np.array([(i, j) for i in range(8) for j in range(i + 1, min(i + 4, 8))])


def _refined(dimension, start, *, trust=None, of_points=None):
    scans = surfaces(prepare(small_world(dimension), 300))
    trust = np.ones(len(EDGES)) if trust is None else trust
    of_points = [np.ones(len(scan.points)) for scan in scans] if of_points is None else of_points
    return refine(scans, EDGES, start.matrix.numpy(), (trust, of_points))


def _off(found, dimension):
    return np.abs(found - true_poses(small_world(dimension)).matrix.numpy()).max()


@pytest.mark.parametrize("dimension", [2, 3])
def test_displaced_poses_come_back(dimension):
    start = displaced(true_poses(small_world(dimension)), 0.05)
    found = _refined(dimension, start)
    assert np.array_equal(found[0], start.matrix.numpy()[0])
    assert _off(found, dimension) < 0.03 < _off(start.matrix.numpy(), dimension)


def test_the_same_in_any_unit():
    scans = surfaces(prepare(small_world(2), 300))
    start = displaced(true_poses(small_world(2)), 0.05).matrix.numpy()
    large = [
        type(scan)(1000 * scan.points, scan.normals, type(scan.tree)(1000 * scan.points), 1000 * scan.spacing)
        for scan in scans
    ]
    scaled = start.copy()
    scaled[:, :2, 2] *= 1000
    weights = np.ones(len(EDGES)), [np.ones(len(scan.points)) for scan in scans]
    one, other = refine(scans, EDGES, start, weights), refine(large, EDGES, scaled, weights)
    np.testing.assert_allclose(other[:, :2, 2] / 1000, one[:, :2, 2], atol=1e-7)


def test_points_and_edges_without_weight_do_not_pull():
    scans = surfaces(prepare(small_world(2), 300))
    start = true_poses(small_world(2))
    torch.manual_seed(0)
    silent = [np.zeros(len(scan.points)) for scan in scans]
    silent[0][:] = silent[1][:] = 1
    found = _refined(2, start, of_points=silent)
    np.testing.assert_allclose(found[2:], start.matrix.numpy()[2:], atol=1e-12)
    assert not np.allclose(found[1], start.matrix.numpy()[1], atol=1e-9)
