"""All poses at once: exact where the scans are, in any unit; points without weight do not pull."""

import numpy as np
import pytest
import torch

from bbr_layer import RigidMotion
from train.prepared import prepare
from train.refinement import refine
from train.scans import ScanSet
from train.surfaces import surfaces

SCANS, SIDES = 5, np.array([4.0, 3.0, 2.5])
EDGES = np.array([(i, j) for i in range(SCANS) for j in range(i + 1, SCANS)])


def _box(d, unit=1.0):
    """Scans of the walls of a box, each at points of its own, from places along it; and where they were."""
    random, k = np.random.default_rng(0), d * (d - 1) // 2
    turns = torch.tensor(random.uniform(-0.3, 0.3, size=(SCANS, k)))
    places = torch.tensor(unit * random.uniform(1, 2, size=(SCANS, d)))
    poses = RigidMotion.from_rotvec(turns, places)
    clouds = []
    for scan in range(SCANS):
        points = random.uniform(0, 1, size=(500 * (d - 1) ** 2, d))
        axis = np.arange(len(points)) % d
        points[np.arange(len(points)), axis] = points[np.arange(len(points)), axis] > 0.5
        world = torch.from_numpy(unit * SIDES[:d] * points)
        clouds.append(poses.item(scan).inverse()(world).numpy())
    scans = ScanSet(clouds, [str(i) for i in range(SCANS)], np.arange(SCANS, dtype=float))
    return surfaces(prepare(scans, 2000)), poses.matrix.numpy()


def _shaken(poses, metres):
    shaken = poses.copy()
    shaken[1:, :-1, -1] += metres * np.random.default_rng(1).normal(size=shaken[1:, :-1, -1].shape)
    return shaken


def _alike(scans):
    return np.ones(len(EDGES)), [np.ones(len(scan.points)) for scan in scans]


@pytest.mark.parametrize("d", [2, 3])
def test_displaced_poses_come_back(d):
    scans, truth = _box(d)
    start = _shaken(truth, 0.03)
    found = refine(scans, EDGES, start, _alike(scans))
    assert np.array_equal(found[0], truth[0])
    assert np.abs(found - truth).max() < 2e-3 < 0.02 < np.abs(start - truth).max()


def test_the_same_in_any_unit():
    (small, truth), (large, scaled) = _box(2), _box(2, unit=1000.0)
    one = refine(small, EDGES, _shaken(truth, 0.03), _alike(small))
    other = refine(large, EDGES, _shaken(scaled, 30.0), _alike(large))
    np.testing.assert_allclose(other[:, :2, 2] / 1000, one[:, :2, 2], atol=1e-5)


def test_a_wrong_edge_without_trust_and_points_without_weight_do_not_pull():
    scans, truth = _box(2)
    start = _shaken(truth, 0.03)
    trust, of_points = _alike(scans)
    of_points[4][:] = 0
    found = refine(scans, EDGES, start, (trust, of_points))
    assert np.array_equal(found[4], start[4]) and np.abs(found[:4] - truth[:4]).max() < 2e-3
    trust[EDGES[:, 1] == 4] = 0
    again = refine(scans, EDGES, start, (trust, _alike(scans)[1]))
    np.testing.assert_allclose(again, found, atol=1e-6)


@pytest.mark.parametrize("d", [2, 3])
def test_scans_that_no_edge_joins_to_the_first_stay_where_they_are_as_a_whole(d):
    scans, truth = _box(d)
    noise = np.random.default_rng(2)
    for scan in scans:
        scan.points[...] += 0.02 * noise.normal(size=scan.points.shape)
    apart = np.array([(0, 1), (2, 3), (2, 4), (3, 4)])
    found = refine(scans, apart, truth, (np.ones(len(apart)), [np.ones(len(scan.points)) for scan in scans]))
    turned = np.linalg.inv(truth[2:, :d, :d]) @ found[2:, :d, :d]
    common = (turned[:, 1, 0] - turned[:, 0, 1]).mean() / 2
    assert abs(common) < 2e-3
    assert np.abs((found - truth)[2:, :d, d].mean(axis=0)).max() < 5e-3


@pytest.mark.parametrize("d", [2, 3])
def test_the_side_that_normals_point_to_plays_no_part(d):
    found = []
    for sign in (1.0, -1.0):
        scans, truth = _box(d)
        scans[1].normals[...] *= sign
        found.append(refine(scans, EDGES, _shaken(truth, 0.03), _alike(scans)))
    np.testing.assert_allclose(*found, atol=1e-9)


def test_points_without_weight_do_not_pull_as_targets_either():
    scans, truth = _box(2)
    start, (trust, of_points) = _shaken(truth, 0.03), _alike(scans)
    of_points[4][:] = 0
    found = refine(scans, EDGES[:, ::-1], start, (trust, of_points))
    assert np.array_equal(found[4], start[4]) and np.abs(found[:4] - truth[:4]).max() < 2e-3


def test_without_an_edge_of_any_weight_the_poses_stay():
    scans, truth = _box(2)
    start, (trust, of_points) = _shaken(truth, 0.03), _alike(scans)
    assert np.array_equal(refine(scans, EDGES, start, (np.zeros_like(trust), of_points)), start)
