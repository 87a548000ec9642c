"""The simulated worlds: true to their own truth, the same for the same seed, and like a building."""

import numpy as np
import pytest
import trimesh
from shapely import LineString
from simulated_worlds import simulate, simulate_afresh, small
from trimesh.ray.ray_triangle import RayMeshIntersector

from train.floor_plans import draw_floor_plan
from train.movers import FARTHEST_COMPANION, draw_movers
from train.routes import draw_route, drive
from train.simulate import DEFAULTS, SENSOR_HEIGHT_2D, WorldSettings, ray_directions
from train.worlds import build_world

KINDS = ("rooms", "loop", "corridor")
# The robot's half width in metres: it must fit through everywhere it goes.
ROBOT = 0.25
# More than from the middle of a trolley to its corner, in metres: the sensor is never inside a mover.
NEAREST = 0.5


def in_world(simulated):
    """All points carried by the true poses, in 3D."""
    points = []
    for scan, pose in zip(simulated.points, simulated.world_from_scan, strict=True):
        d = scan.shape[1]
        points.append(scan @ pose[:3, :d].T + pose[:3, 3])
    return np.vstack(points)


def surface_distances(mesh, points):
    return trimesh.proximity.closest_point(mesh, points)[1]


def way_of(settings):
    plan, random = draw_floor_plan(settings), settings.random("route")
    route = draw_route(plan, random)
    return plan, route, *drive(route, settings, random)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_true_poses_carry_points_onto_the_surfaces(kind, dimension, rng):
    simulated = simulate(small(dimension, kind=kind, noise_m=0.0, ceiling=True))
    points = in_world(simulated)
    some = points[rng.choice(len(points), 200, replace=False)]
    assert surface_distances(simulated.world, some).max() < 1e-5
    assert np.ptp(points[:, 2]) > 2 if dimension == 3 else np.abs(points[:, 2]).max() == 0


def test_noise_is_along_the_ray_and_of_the_size_asked_for():
    clean, noisy = (simulate(small(noise_m=noise)) for noise in (0.0, 0.05))
    clean_ranges, noisy_ranges = (np.linalg.norm(np.vstack(s.points), axis=1) for s in (clean, noisy))
    assert (noisy_ranges - clean_ranges).std() == pytest.approx(0.05, rel=0.1)
    products = np.sum(np.vstack(clean.points) * np.vstack(noisy.points), axis=1)
    np.testing.assert_allclose(products, clean_ranges * noisy_ranges)


@pytest.mark.parametrize("dimension", [2, 3])
def test_labelled_points_are_on_movers_and_no_others(dimension, rng):
    settings = small(dimension, movers=3, noise_m=0.0)
    simulated = simulate(settings)
    labels = np.concatenate(simulated.mover_labels)
    assert 0.005 < labels.mean() < 0.5
    still = in_world(simulated)[~labels]
    assert surface_distances(simulated.world, still[rng.choice(len(still), 200)]).max() < 1e-5

    plan, route, _, times = way_of(settings)
    movers = draw_movers(build_world(plan, route.line(FARTHEST_COMPANION), settings).open_floor, route, times, settings)
    for scan, on_mover in enumerate(simulated.mover_labels):
        one = simulated.points[scan][on_mover]
        if not len(one):
            continue
        pose = simulated.world_from_scan[scan]
        points = one @ pose[:3, :dimension].T + pose[:3, 3]
        solids = [standing(mover, scan, -SENSOR_HEIGHT_2D if dimension == 2 else 0.0) for mover in movers]
        assert surface_distances(trimesh.util.concatenate(solids), points).max() < 1e-5


def standing(mover, scan, floor):
    """The mover's solid where it is at a scan."""
    pose = trimesh.transformations.rotation_matrix(mover.headings[scan], [0, 0, 1])
    pose[:3, 3] = [*mover.positions[scan], floor]
    return mover.solid.copy().apply_transform(pose)


def test_movers_only_hide_the_world_and_leave_it_as_it_was():
    empty, busy = simulate(small(movers=0, noise_m=0.0)), simulate(small(movers=3, noise_m=0.0))
    np.testing.assert_array_equal(empty.world.vertices, busy.world.vertices)
    np.testing.assert_array_equal(empty.world_from_scan, busy.world_from_scan)
    for before, after, on_mover in zip(empty.points, busy.points, busy.mover_labels, strict=True):
        np.testing.assert_allclose(before[~on_mover], after[~on_mover], atol=1e-12)
        nearer = np.linalg.norm(before, axis=1) - np.linalg.norm(after, axis=1)
        assert (nearer[on_mover] > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_movers_move_and_leave_the_sensor_alone(kind):
    settings = WorldSettings(kind=kind, movers=4, seed=1)
    plan, route, poses, times = way_of(settings)
    world = build_world(plan, route.line(FARTHEST_COMPANION), settings)
    for mover in draw_movers(world.open_floor, route, times, settings):
        away = np.linalg.norm(mover.positions - poses[:, :2, 3], axis=1)
        steps = np.linalg.norm(np.diff(mover.positions, axis=0), axis=1)
        assert away.min() > NEAREST
        assert steps.max() < 1.0 and np.median(steps) > 0.1


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_same_seed_is_the_same_world_and_another_is_another(dimension):
    first, again, other = (simulate_afresh(small(dimension, movers=2, seed=seed)) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.world_from_scan, again.world_from_scan)
    np.testing.assert_array_equal(first.world.vertices, again.world.vertices)
    for one, two in zip(first.points, again.points, strict=True):
        np.testing.assert_array_equal(one, two)
    assert not np.allclose(first.world_from_scan, other.world_from_scan)


def test_twenty_seeds_are_twenty_different_buildings():
    plans = [draw_floor_plan(WorldSettings(seed=seed)) for seed in range(20)]
    areas = sorted(plan.footprint.area for plan in plans)
    assert np.diff(areas).min() > 0.01
    assert len({(len(plan.cells), len(plan.doors.openings), len(plan.doors.recesses)) for plan in plans}) > 8


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_the_robot_drives_smoothly_through_doors_and_bumps_into_nothing(kind, seed):
    settings = WorldSettings(kind=kind, seed=seed)
    plan, route, poses, _ = way_of(settings)
    steps = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    headings = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    assert 0.2 < steps.min() and steps.max() < 0.6 and 0.4 < steps.mean()
    assert np.rad2deg(np.abs(np.diff(headings))).max() <= 15
    # It looks where it goes: half a turn between two scans is the most that chord and heading may differ by.
    chords = np.diff(poses[:, :2, 3], axis=0) / steps[:, None]
    looks = (poses[:-1, :2, 0] + poses[1:, :2, 0]) / 2
    assert np.sum(chords * looks, axis=1).min() > np.cos(np.deg2rad(8))
    world = build_world(plan, route.line(0), settings)
    assert world.open_floor.covers(LineString(poses[:, :2, 3]).buffer(ROBOT))


@pytest.mark.parametrize("kind", KINDS)
def test_places_are_seen_again(kind):
    positions = way_of(WorldSettings(kind=kind))[2][:, :2, 3]
    distances = np.linalg.norm(positions[:, None] - positions, axis=-1)
    later = np.subtract.outer(np.arange(64), np.arange(64)) > 20
    assert (distances[later] < 1.0).sum() > 5


def test_a_rooms_tour_passes_doors_and_every_room_has_a_door_or_a_shut_one():
    plan = draw_floor_plan(WorldSettings(kind="rooms", seed=3))
    tour = LineString(np.vstack([plan.tour, plan.tour[:1]]))
    assert sum(opening.intersects(tour) for opening in plan.doors.openings) >= 2
    doors = [*plan.doors.openings, *plan.doors.recesses]
    assert all(any(floor.buffer(0.1).intersects(door) for door in doors) for floor in plan.floors)


@pytest.mark.parametrize("dimension", [2, 3])
def test_counts_shapes_and_times(dimension):
    settings = small(dimension, range_max_m=1000.0, ceiling=True)
    simulated = simulate(settings)
    rays = settings.beams * (settings.rings if dimension == 3 else 1)
    assert [scan.shape for scan in simulated.points] == [(rays, dimension)] * 20
    assert [labels.shape for labels in simulated.mover_labels] == [(rays,)] * 20
    assert simulated.world_from_scan.shape == (20, 4, 4) and simulated.timestamps.shape == (20,)
    rotations = simulated.world_from_scan[:, :3, :3]
    products = rotations @ rotations.swapaxes(1, 2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-12)
    assert (np.diff(simulated.timestamps) > 0).all()


def test_the_first_pose_may_be_anything():
    starts = [way_of(small(seed=seed))[2][0] for seed in range(6)]
    assert min(np.abs(start - np.eye(4)).max() for start in starts) > 0.1
    assert np.ptp([np.arctan2(start[1, 0], start[0, 0]) for start in starts]) > 1


def test_returns_from_beyond_the_range_are_missing():
    simulated = simulate(small(range_max_m=2.0, noise_m=0.0))
    assert 0 < sum(map(len, simulated.points)) < 20 * 48
    assert max(np.linalg.norm(scan, axis=1).max() for scan in simulated.points) <= 2.0


def test_a_narrow_view_looks_ahead():
    rays = ray_directions(WorldSettings(beams=9, field_of_view_deg=90))
    angles = np.rad2deg(np.arctan2(rays[:, 1], rays[:, 0]))
    np.testing.assert_allclose(angles, np.linspace(-40, 40, 9), atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ray_directions(DEFAULTS[3]), axis=1), 1)


def test_the_plain_ray_caster_sees_the_same(monkeypatch):
    settings = small(movers=2)
    usual = simulate(settings)
    monkeypatch.setattr("trimesh.ray.has_embree", False)
    plain = simulate_afresh(settings)
    assert isinstance(plain.world.ray, RayMeshIntersector)
    for one, two in zip(usual.points, plain.points, strict=True):
        assert len(one) == len(two)
        # Embree works in float32: a ray that grazes an edge may go either way.
        assert np.mean(np.abs(one - two).max(axis=1) < 1e-4) > 0.97


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"kind": "maze"}, "kind is 'maze'; choose one of 'rooms', 'loop', 'corridor'"),
        ({"dimension": 4}, "dimension is 4"),
        ({"scans": 1}, "scans is 1; give a whole number of at least 2"),
        ({"beams": 0}, "beams is 0"),
        ({"rings": 0}, "rings is 0"),
        ({"movers": -1}, "movers is -1"),
        ({"seed": -1}, "seed is -1"),
        ({"noise_m": -0.1}, "noise_m is -0.1"),
        ({"noise_m": float("nan")}, "noise_m is nan"),
        ({"range_max_m": 0.0}, "range_max_m is 0.0"),
        ({"field_of_view_deg": 0.0}, "field_of_view_deg is 0.0"),
        ({"field_of_view_deg": 361.0}, "field_of_view_deg is 361.0"),
    ],
)
def test_a_wrong_setting_is_one_clear_sentence(wrong, words, as_a_user):
    with pytest.raises(ValueError, match="^" + words.replace(".", r"\.")) as raised:
        WorldSettings(**wrong)
    assert "\n" not in str(raised.value)


def test_a_sensor_that_sees_nothing_is_one_clear_sentence():
    with pytest.raises(ValueError, match="no ray of scan 0 returns: range_max_m is 0.05"):
        simulate(small(range_max_m=0.05))
