"""Ray-traced occupancy: known rooms, a loop nobody can misread, and invariances."""

import numpy as np
import pytest

from train.occupancy_grid import LOG_ODDS_HIT, LOG_ODDS_MISS, OccupancyGrid, occupancy_grid


def room_scan(position: np.ndarray, beams: int = 720, half: float = 2.0) -> np.ndarray:
    """What a sensor at ``position`` sees of a square room with walls at +-half, along the world's axes."""
    angles = np.linspace(0, 2 * np.pi, beams, endpoint=False) + 1e-3
    directions = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    room = np.where(directions > 0, half - position, -half - position)
    return directions * np.min(room / directions, axis=1)[:, None]


def poses_2d(*placements: tuple[float, float, float]) -> np.ndarray:
    """``world_from_scan`` from (x, y, heading)."""
    return np.array([[[np.cos(a), -np.sin(a), x], [np.sin(a), np.cos(a), y], [0, 0, 1]] for x, y, a in placements])


def cell(grid: OccupancyGrid, x: float, y: float) -> tuple[int, int]:
    return int((y - grid.origin[1]) / grid.resolution), int((x - grid.origin[0]) / grid.resolution)


def test_a_room_has_walls_around_free_space():
    grid = occupancy_grid([room_scan(np.zeros(2))], poses_2d((0, 0, 0)), resolution=0.05)
    assert grid.probability[cell(grid, 0.3, -1.2)] == pytest.approx(0.4, abs=0.01)
    assert grid.probability[cell(grid, 1.999, 0.6)] == pytest.approx(0.7, abs=0.01)
    corner = cell(grid, -2.06, -2.06)
    assert grid.probability[corner] == 0.5 and not grid.observed[corner]
    assert grid.hits.sum() == pytest.approx(4 * 4.0 / 0.05, rel=0.05)


def test_the_pose_carries_the_scan():
    """A room seen from two places, by a turned sensor, gives walls in the same cells."""
    x, y, heading = 0.7, -0.4, 2.1
    pose = poses_2d((x, y, heading))
    turned = room_scan(np.array([x, y])) @ pose[0, :2, :2]
    scans, poses = [room_scan(np.zeros(2)), turned], np.concatenate((poses_2d((0, 0, 0)), pose))
    grid = occupancy_grid(scans, poses, resolution=0.1)
    assert grid.hits.max() == 2
    for place in ((1.999, 0.55), (-1.999, -0.55), (0.55, 1.999), (-0.55, -1.999)):
        assert grid.hits[cell(grid, *place)] == 2


def test_cells_are_those_of_a_loop_over_the_rays():
    rng = np.random.default_rng(0)
    scan, poses = rng.normal(size=(60, 2)), poses_2d((0.2, -0.1, 0.5))
    grid = occupancy_grid([scan], poses, resolution=0.07)
    expected = np.zeros(grid.hits.shape, dtype=int)
    ends = scan @ poses[0, :2, :2].T + poses[0, :2, 2]
    for end in ends:
        ray = end - poses[0, :2, 2]
        steps = int(np.ceil(np.abs(ray / grid.resolution).max()))
        for step in range(steps):
            expected[cell(grid, *(poses[0, :2, 2] + ray * step / steps))] = -1
    for end in ends:
        expected[cell(grid, *end)] = 1
    np.testing.assert_array_equal(grid.hits - grid.misses, expected)


def test_a_hit_outweighs_passes_of_the_same_scan_but_not_of_others():
    scan = np.array([[1.05, 0.0], [2.05, 0.0]])
    grid = occupancy_grid([scan, scan[1:], scan[1:]], poses_2d(*[(0, 0.01, 0)] * 3), resolution=0.1)
    row, column = cell(grid, 1.05, 0.01)
    assert (grid.hits[row, column], grid.misses[row, column]) == (1, 2)
    log_odds = LOG_ODDS_HIT + 2 * LOG_ODDS_MISS
    assert grid.probability[row, column] == pytest.approx(1 / (1 + np.exp(-log_odds)))


def test_the_order_of_scans_and_points_does_not_matter():
    rng = np.random.default_rng(0)
    scans = [rng.normal(size=(40, 2)) for _ in range(6)]
    poses = poses_2d(*rng.normal(size=(6, 3)))
    forward = occupancy_grid(scans, poses)
    backward = occupancy_grid([scan[::-1] for scan in scans[::-1]], poses[::-1])
    np.testing.assert_array_equal(forward.hits, backward.hits)
    np.testing.assert_array_equal(forward.misses, backward.misses)


def test_many_long_rays_are_traced_in_chunks(monkeypatch):
    scans, poses = [room_scan(np.zeros(2))], poses_2d((0, 0, 0))
    whole = occupancy_grid(scans, poses)
    monkeypatch.setattr("train.occupancy_grid.STEPS_PER_CHUNK", 1000)
    np.testing.assert_array_equal(occupancy_grid(scans, poses).misses, whole.misses)


def test_3d_rays_count_within_the_slab_around_the_sensor():
    """Median range 10 makes a slab of +-0.5 around the sensor at height 7."""
    scan = np.array([[10.0, 0.0, 0.2], [0.0, 8.0, -2.0], [0.0, -10.0, 6.0], [-10.0, 0.0, 0.0]])
    pose = np.eye(4)[None].copy()
    pose[0, 2, 3] = 7.0
    grid = occupancy_grid([scan], pose, resolution=0.25)
    half_height = 0.05 * np.median(np.linalg.norm(scan, axis=1))
    assert grid.hits.sum() == 2
    assert grid.hits[cell(grid, 10.0, 0.0)] == 1 and grid.hits[cell(grid, -10.0, 0.0)] == 1
    leaves_at = 8.0 * half_height / 2.0
    assert grid.misses[cell(grid, 0.0, leaves_at - 0.3)] == 1
    assert not grid.observed[cell(grid, 0.0, leaves_at + 0.3)]


def test_one_far_return_does_not_blow_up_the_grid():
    scan = np.concatenate((room_scan(np.zeros(2)), [[1e7, 1e7]]))
    grid = occupancy_grid([scan], poses_2d((0, 0, 0)))
    left, right, bottom, top = grid.extent
    assert 4 < right - left < 10 and 4 < top - bottom < 10
    assert grid.hits.sum() > 0 and max(grid.hits.shape) <= 2000
    assert grid.misses[-1, -1] + grid.misses[-2, -2] > 0  # the far ray is free up to the border


@pytest.mark.parametrize(("size", "expected"), [(1.0, 0.001), (300.0, 0.2), (4000.0, 5.0)])
def test_the_default_resolution_is_a_round_number(size, expected):
    scan = room_scan(np.zeros(2), beams=9000, half=size / 2)
    grid = occupancy_grid([scan], poses_2d((0, 0, 0)))
    assert grid.resolution == pytest.approx(expected)
    assert 800 <= max(grid.hits.shape) <= 2000


def test_the_default_resolution_is_not_finer_than_the_rays():
    """With 180 rays to walls 2 away, neighbouring points lie 0.07 to 0.14 apart: few free cells are missed."""
    grid = occupancy_grid([room_scan(np.zeros(2), beams=180)], poses_2d((0, 0, 0)))
    assert grid.resolution == pytest.approx(0.05)
    row, column = cell(grid, -1, -1)
    row_end, column_end = cell(grid, 1, 1)
    assert grid.observed[row:row_end, column:column_end].mean() > 0.95


def test_progress_is_told():
    calls = []
    scans, poses = [room_scan(np.zeros(2))] * 3, poses_2d(*[(0, 0, 0)] * 3)
    occupancy_grid(scans, poses, progress=lambda *call: calls.append(call))
    assert calls == [("occupancy", 1, 3), ("occupancy", 2, 3), ("occupancy", 3, 3)]


@pytest.mark.parametrize(
    ("scans", "settings", "words"),
    [
        ([np.zeros((3, 2))] * 2, {}, "2 scans for 1 poses"),
        ([np.zeros((0, 2))], {}, "give each pose its points"),
        ([np.ones((3, 2))], {"resolution": -1.0}, "resolution is -1"),
        ([np.ones((3, 2))], {"resolution": 1e-6}, "choose it coarser"),
    ],
)
def test_bad_input_is_refused_in_words(scans, settings, words):
    with pytest.raises(ValueError, match=words):
        occupancy_grid(scans, poses_2d((0, 0, 0)), **settings)


def test_the_slab_is_at_least_a_cell_high():
    assert occupancy_grid([np.array([[1.0, 0.0, 0.3]])], np.eye(4)[None], resolution=0.5).hits.sum() == 1
