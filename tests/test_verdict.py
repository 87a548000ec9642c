"""The verdict on an answer: pairs, closeness, and the direction that the points hold least."""

import numpy as np
import pytest

from bbr_layer.verdict import give_verdict, weakest_direction


def sphere(rng, count):
    points = rng.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def plane_information(points, normals):
    """Sum of J^T J for residuals along the normals, about the centroid."""
    arms = points - points.mean(axis=0)
    jacobian = np.hstack((np.cross(arms, normals), normals))
    return jacobian.T @ jacobian


def test_one_surface_sampled_twice_is_trusted(rng):
    P, moved = sphere(rng, 1500), sphere(rng, 1500)
    verdict = give_verdict(P, moved, np.eye(6), "converged")
    assert verdict.trustworthy
    assert 0.8 < verdict.close_share < 0.9  # what chance gives on any surface
    assert verdict.sentence == (
        f"Trustworthy: {verdict.buddy_share:.0%} of the points have a best buddy, "
        f"{verdict.close_share:.0%} of them closer than their neighbours."
    )


def test_pairs_are_counted_as_loops_would(rng):
    P, moved = rng.normal(size=(12, 3)), rng.normal(size=(9, 3))
    D = np.linalg.norm(P[:, None] - moved[None], axis=-1)
    pairs = [(i, j) for i in range(12) for j in range(9) if D[i, j] == D[i].min() == D[:, j].min()]
    verdict = give_verdict(P, moved, np.eye(6), "converged")
    assert verdict.buddies == len(pairs)
    assert verdict.buddy_share == len(pairs) / 9
    assert verdict.residual_rms == pytest.approx(np.sqrt(np.mean([D[i, j] ** 2 for i, j in pairs])))
    gaps = [np.sort(np.linalg.norm(c[:, None] - c[None], axis=-1), axis=1)[:, 1] for c in (P, moved)]
    close = [D[i, j] <= (gaps[0][i] + gaps[1][j]) / 2 for i, j in pairs]
    assert verdict.close_share == np.mean(close)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_gap_between_the_surfaces_is_doubted_in_any_unit(rng, scale):
    P, moved = sphere(rng, 1000), 1.05 * sphere(rng, 1000)
    verdict = give_verdict(scale * P, scale * moved, np.eye(6), "converged")
    assert not verdict.trustworthy
    assert 0.2 < verdict.close_share < 0.7  # the gap is one point spacing wide
    assert "closer than the points around them" in verdict.sentence


def test_an_exact_copy_and_a_stray_overlap(rng):
    P = sphere(rng, 800)
    assert give_verdict(P, P, np.eye(6), "converged").close_share == 1.0
    apart = np.vstack((P[:40], P + [50, 0, 0]))[:800]
    verdict = give_verdict(P, apart, np.eye(6), "converged")
    assert verdict.buddy_share < 0.1
    assert "of the points have a best buddy" in verdict.sentence
    assert not verdict.trustworthy


def test_words_other_than_converged_forbid_trust(rng):
    P = sphere(rng, 300)
    verdict = give_verdict(P, P, np.eye(6), "the pose was still moving: give it more steps")
    assert not verdict.trustworthy
    assert "the pose was still moving." in verdict.sentence.replace(". Try", ".")


def test_a_corridor_gives_way_along_itself(rng):
    x, side = rng.uniform(-10, 10, 400), rng.uniform(-1, 1, 400)
    walls = np.stack((x, np.where(np.arange(400) % 2, 1.0, side), np.where(np.arange(400) % 2, side, 1.0)), axis=1)
    normals = np.where((np.arange(400) % 2 == 1)[:, None], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    weakest = weakest_direction(plane_information(walls, normals), walls, 0.1)
    assert not weakest.turning
    np.testing.assert_allclose(weakest.axis, [1, 0, 0], atol=1e-9)
    assert weakest.share < 1e-12
    assert weakest.deviation == np.inf


def test_a_vase_gives_way_about_its_axis(rng):
    points = sphere(rng, 500) * [1, 1, 2]
    normals = points / [1, 1, 4]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    weakest = weakest_direction(plane_information(points, normals), points, 0.1)
    assert weakest.turning
    assert weakest.axis[2] > 0.99


def test_deviation_is_that_of_a_mean():
    """400 unit residuals along z: the mean is known to 1 / 20 of one; other directions far better."""
    information = np.diag([1e9, 1e9, 1e9, 1e9, 1e9, 400.0])
    points = np.random.default_rng(1).normal(size=(400, 3))
    weakest = weakest_direction(information, points, 1.0)
    assert weakest.deviation == pytest.approx(1 / 20)
    np.testing.assert_allclose(weakest.axis, [0, 0, 1], atol=1e-6)
    radius = np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, axis=1)))
    turning = weakest_direction(np.diag([400.0 * radius**2, 1e9, 1e9, 1e9, 1e9, 1e9]), points, 1.0)
    assert turning.turning
    assert turning.deviation == pytest.approx(1 / (20 * radius))


def test_the_plane_has_one_way_to_turn(rng):
    points = rng.normal(size=(50, 2))
    weakest = weakest_direction(np.diag([1e-3, 50.0, 50.0]), points, 0.1)
    assert weakest.turning
    np.testing.assert_array_equal(weakest.axis, [0, 0, 1])
