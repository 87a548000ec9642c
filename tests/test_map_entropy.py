"""Mean map entropy against its formula as a loop, against known densities, and where it is undefined."""

import numpy as np
import pytest
from small_worlds import displaced, small_world, true_poses

from benchmarks.crispness import KINDS, entropy, line, radius_of
from train.map_entropy import PAIRS_PER_CHUNK, mean_map_entropy


def entropy_by_loop(points: np.ndarray, radius: float) -> float:
    entropies = []
    for query in points:
        near = points[np.linalg.norm(points - query, axis=1) <= radius]
        if len(near) - 1 >= 5:
            covariance = np.cov(near.T, bias=True)
            entropies.append(0.5 * np.log(np.linalg.det(2 * np.pi * np.e * covariance)))
    return float(np.mean(entropies))


@pytest.mark.parametrize("d", [2, 3])
def test_formula(d):
    points = np.random.default_rng(0).normal(size=(300, d))
    assert mean_map_entropy(points, 0.5) == pytest.approx(entropy_by_loop(points, 0.5), rel=1e-12)


def test_far_from_the_origin_nothing_changes():
    points = np.random.default_rng(0).normal(size=(300, 2))
    assert mean_map_entropy(points + 1e6, 0.5) == pytest.approx(mean_map_entropy(points, 0.5), abs=1e-7)


def test_many_pairs_are_counted_in_chunks():
    points = np.random.default_rng(0).uniform(size=(1600, 2))
    assert len(points) ** 2 > PAIRS_PER_CHUNK
    expected = 0.5 * np.log(np.linalg.det(2 * np.pi * np.e * np.cov(points.T, bias=True)))
    assert mean_map_entropy(points, 10.0) == pytest.approx(expected, rel=1e-12)


def test_uniform_plane_has_the_entropy_of_a_disc():
    """A uniform disc of radius r has variance r^2 / 4 along each axis; the plane's border weighs little."""
    axis = np.linspace(-1, 1, 301)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    assert mean_map_entropy(points, 0.05) == pytest.approx(np.log(2 * np.pi * np.e * 0.05**2 / 4), abs=0.05)


def test_a_doubled_wall_is_less_crisp_than_a_single_one():
    rng = np.random.default_rng(0)
    wall = np.stack((rng.uniform(0, 10, 4000), 0.005 * rng.normal(size=4000)), axis=1)
    doubled = wall + np.stack((np.zeros(4000), np.where(np.arange(4000) % 2, 0.1, 0.0)), axis=1)
    assert mean_map_entropy(doubled, 0.3) > mean_map_entropy(wall, 0.3) + 1


def test_a_perfectly_flat_wall_stays_finite():
    wall = np.stack((np.linspace(0, 1, 200), np.zeros(200)), axis=1)
    assert np.isfinite(mean_map_entropy(wall, 0.1))


def test_neighbourhoods_of_five_points_are_left_out():
    cross = np.array([[0, 0], [0.1, 0], [-0.1, 0], [0, 0.1], [0, -0.1]])
    assert np.isnan(mean_map_entropy(cross, 1.0))
    assert np.isfinite(mean_map_entropy(np.concatenate((cross, [[0.1, 0.1]])), 1.0))


@pytest.mark.parametrize(
    ("points", "radius", "words"),
    [
        (np.zeros((5, 4)), 1.0, "shape"),
        (np.zeros((5, 3)), 0.0, "radius is 0"),
        (np.full((5, 3), np.nan), 1.0, "NaN"),
    ],
)
def test_bad_input_is_refused_in_words(points, radius, words):
    with pytest.raises(ValueError, match=words):
        mean_map_entropy(points, radius)


def test_poses_off_the_truth_make_the_map_of_the_bench_less_crisp():
    scans = small_world(3)
    off = displaced(true_poses(scans), 0.05).matrix.numpy()
    assert entropy(scans, scans.truth, 0.5) < entropy(scans, off, 0.5) - 0.1
    assert radius_of("dragon scans") == 0.003 and radius_of("v1_pose0, stride 1") is None


def test_the_least_entropy_of_a_row_is_bold():
    found = {"truth": {"entropy": -1.0, "error": 0.0}, "ours": {"entropy": -2.0, "error": 0.01}}
    found |= {title: {"entropy": -1.5, "error": 0.02} for title in KINDS}
    wanted = "| tum, stride 1 | 0.03 | -1.000 | **-2.000** (0.01) | -1.500 (0.02) | -1.500 (0.02) |"
    assert line("tum, stride 1", found) == wanted
