"""All scans as one map: planes through many scans' points, how thick they are, and poses that make them thin."""

import numpy as np
import pytest
import torch
from map_problems import square_room

from bbr_layer import RigidMotion
from train.data_module import prepare_scan
from train.planes import fitted
from train.scans import ScanSet
from train.surface_map import MapScore, SurfaceMap

PLACES = np.array([[0.0, 0.0], [0.3, 0.1], [0.6, 0.3], [0.8, 0.6], [0.7, 0.9], [0.4, 1.0]])


def room(d, noise=0.0):
    """Scans of a square room from six places, turned as the world is; and their poses."""
    random = np.random.default_rng(0)
    poses = np.tile(np.eye(d + 1), (len(PLACES), 1, 1))
    poses[:, :2, d] = PLACES - PLACES[0]
    scans = [square_room(place) for place in PLACES - PLACES[0]]
    if d == 3:
        # Walls as columns of points, and a slanted floor's edge of them: every direction is held.
        floor = np.stack(np.meshgrid(np.linspace(-2, 2, 25), np.linspace(-2, 2, 25)), -1).reshape(-1, 2)
        walls = [np.concatenate([np.insert(scan, 2, z, axis=1) for z in np.linspace(-0.4, 0.4, 5)]) for scan in scans]
        scans = [
            np.concatenate((w, np.insert(floor - p[:2, 3], 2, -0.5, axis=1))) for w, p in zip(walls, poses, strict=True)
        ]
    scans = [scan + noise * random.normal(size=scan.shape) for scan in scans]
    return ScanSet(scans, [str(n) for n in range(len(scans))], np.arange(float(len(scans))), truth=poses)


def shaken(poses, by):
    random = np.random.default_rng(1)
    found = poses.copy()
    found[1:, :-1, -1] += by * random.normal(size=found[1:, :-1, -1].shape)
    return found


def surface_map(scans, poses):
    return SurfaceMap(scans, [prepare_scan(points, 512) for points in scans.points], poses)


def error(poses, truth):
    return np.sqrt(((poses - truth)[:, :-1, -1] ** 2).sum(axis=1).mean())


def test_a_plane_is_fitted_without_what_lies_far_off():
    along = np.linspace(-1, 1, 21)
    points = np.concatenate((np.stack((along, 0.5 * along), 1), [[0.0, 1.0]]))
    numbers = np.zeros(22, dtype=int), np.arange(22)
    planes = fitted(*numbers, points, np.ones(22), 0.05)
    assert np.abs(planes.offset[:21, 0]).max() < 0.002
    assert planes.weight[:21].min() > 0.99 and planes.weight[21] < 1e-3
    assert np.abs(fitted(*numbers, points, np.ones(22), None).offset[:21, 0]).max() > 0.03


@pytest.mark.parametrize("d", [2, 3])
def test_the_adjusted_poses_are_nearer_to_the_truth(d):
    scans = room(d, noise=0.005)
    start = shaken(scans.truth, 0.02)
    found = surface_map(scans, start).adjusted(start)
    assert np.array_equal(found[0], start[0])
    assert error(found, scans.truth) < 0.25 * error(start, scans.truth)


def test_a_scan_that_shares_no_surface_stays_where_it_is():
    scans, away = room(2, noise=0.005), np.array([50.0, 0.0])
    poses = np.concatenate((scans.truth, scans.truth[:1]))
    poses[-1, :2, 2] = away
    lonely = ScanSet([*scans.points, scans.points[3]], [*scans.names, "away"], np.arange(len(poses), dtype=float))
    start = shaken(poses, 0.02)
    found = surface_map(lonely, start).adjusted(start)
    assert np.abs(found[-1] - start[-1]).max() < 1e-4
    assert error(found[:-1], scans.truth) < 0.25 * error(start[:-1], scans.truth)


def test_the_map_is_thicker_at_shaken_poses_and_where_scans_lie_alone():
    scans = room(2, noise=0.005)
    surfaces = surface_map(scans, scans.truth)
    assert surfaces.thickness(scans.truth) < 0.7 * surfaces.thickness(shaken(scans.truth, 0.02))
    surfaces.reach = 1e-9
    assert surfaces.thickness(scans.truth) == 0.5


def test_the_two_sides_of_a_wall_are_two_surfaces():
    """Two scans on both sides of a thin wall: no point of the one belongs to a plane of the other."""
    along = np.linspace(-1, 1, 101)
    near, far = (np.stack((along, np.full(101, height)), 1) for height in (1.0, -1.0))
    scans = ScanSet([near, far], ["below", "above"], np.arange(2.0))
    poses = np.tile(np.eye(3), (2, 1, 1))
    poses[1, 1, 2] = 2.02
    surfaces = surface_map(scans, poses)
    here = surfaces.points.at(poses)
    planes = surfaces._planes(here, None)
    owners = here.owner[planes.point]
    for number in range(len(planes.axes)):
        assert len(set(owners[planes.plane == number])) == 1
    assert surfaces.reach > 0.02


def test_points_that_others_saw_through_weigh_less():
    scans = room(2)
    points = [scan.copy() for scan in scans.points]
    points[2][:8] *= 0.4
    crowded = ScanSet(points, scans.names, scans.timestamps)
    surfaces = surface_map(crowded, scans.truth)
    weight = surfaces.weight[surfaces.points.owner == 2]
    assert weight[:8].max() < 0.5 and weight[20:].min() > 0.9


def test_poses_that_score_no_better_are_refused():
    scans = room(2, noise=0.005)
    surfaces = surface_map(scans, scans.truth)
    start = RigidMotion.from_matrix(torch.from_numpy(scans.truth))
    score = MapScore(lambda poses: 0.0, surfaces)
    surfaces.adjusted = lambda poses, _: shaken(poses, 0.05)
    assert score.adjusted(start) is start
    near = RigidMotion.from_matrix(torch.from_numpy(shaken(scans.truth, 0.05)))
    surfaces.adjusted = lambda poses, _: scans.truth
    assert torch.equal(score.adjusted(near).matrix, start.matrix)
    assert score(start) == pytest.approx(10 * surfaces.thickness(scans.truth))
