"""Trajectory errors: against evo's own functions, and against answers known by hand."""

import numpy as np
import pytest
from evo.core.metrics import PoseRelation
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from evo.main_ape import ape
from evo.main_rpe import rpe
from scipy.spatial.transform import Rotation

from train.evaluate import align_trajectories, evaluate_trajectory, pose_errors


def poses_from(rotation: Rotation, positions: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation.as_matrix(), positions
    return poses


def winding_path(k: int, planar: bool = False, noise: float = 0.0) -> np.ndarray:
    """A path with turns, whose poses are shaken by ``noise`` (unit of length, and radians)."""
    rng = np.random.default_rng(1)
    time = np.linspace(0, 3, k)
    positions = np.stack((3 * time, np.sin(2 * time), 0.3 * np.cos(time)), axis=1)
    rotvecs = np.stack((0.1 * np.sin(time), 0.1 * time, time), axis=1)
    positions, rotvecs = (
        positions + noise * rng.normal(size=(k, 3)),
        rotvecs + noise * rng.normal(size=(k, 3)),
    )
    if planar:
        positions[:, 2], rotvecs[:, :2] = 0, 0
    return poses_from(Rotation.from_rotvec(rotvecs), positions)


def straight_path(k: int, roll: float = 0.0) -> np.ndarray:
    positions = np.stack((np.arange(k), np.zeros(k), np.zeros(k)), axis=1)
    return poses_from(Rotation.from_rotvec(np.tile([roll, 0.0, 0.0], (k, 1))), positions.astype(float))


ELSEWHERE = poses_from(Rotation.from_rotvec([[0.3, -1.0, 2.0]]), np.array([[5.0, -7.0, 2.0]]))[0]
ELSEWHERE_2D = poses_from(Rotation.from_rotvec([[0.0, 0.0, 2.0]]), np.array([[5.0, -7.0, 0.0]]))[0]


@pytest.mark.parametrize("planar", [False, True])
def test_errors_are_those_of_evo(planar):
    truth = winding_path(40, planar)
    estimate = (ELSEWHERE_2D if planar else ELSEWHERE) @ winding_path(40, planar, noise=0.05)
    metrics = evaluate_trajectory(estimate, truth)

    def paths():  # evo aligns in place
        return PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))

    absolute = ape(*paths(), PoseRelation.translation_part, align=True).stats
    for name in ("rmse", "mean", "median", "max"):
        assert metrics[f"ape_{name}"] == pytest.approx(absolute[name], rel=1e-9)
    relations = {
        "rpe_translation_rmse": PoseRelation.translation_part,
        "rpe_rotation_rmse_deg": PoseRelation.rotation_angle_deg,
    }
    for name, relation in relations.items():
        relative = rpe(*paths(), relation, delta=1, delta_unit=Unit.frames, align=True).stats
        assert metrics[name] == pytest.approx(relative["rmse"], rel=1e-9)


@pytest.mark.parametrize("planar", [False, True])
def test_a_common_motion_is_no_error(planar):
    truth = winding_path(25, planar)
    scans = [np.random.default_rng(0).normal(size=(7, 2 if planar else 3)) for _ in truth]
    motion = ELSEWHERE_2D if planar else ELSEWHERE
    metrics = evaluate_trajectory(motion @ truth, truth, scans)
    assert max(metrics.values()) < 1e-5
    np.testing.assert_allclose(align_trajectories(motion @ truth, truth), np.linalg.inv(motion), atol=1e-12)


def test_one_displaced_pose_known_by_hand():
    """On a symmetric path, the middle pose moved by 3 across gives errors 1, 2, 1 after alignment."""
    truth = straight_path(3)
    estimate = truth.copy()
    estimate[1, 1, 3] = 3.0
    metrics = evaluate_trajectory(estimate, truth, [np.zeros((4, 3))] * 3)  # points that lie in the sensor
    assert metrics["ape_rmse"] == pytest.approx(np.sqrt(2))
    assert metrics["ape_mean"] == pytest.approx(4 / 3)
    assert metrics["ape_median"] == pytest.approx(1)
    assert metrics["ape_max"] == pytest.approx(2)
    assert metrics["rpe_translation_rmse"] == pytest.approx(3)
    assert metrics["point_rms_displacement"] == pytest.approx(np.sqrt(2))


def test_rotation_error_is_what_no_common_rotation_removes():
    """Orientations off by +10 and -10 degrees about one axis: no common rotation helps, the mean is 10."""
    truth = winding_path(2, planar=True)
    turns = Rotation.from_euler("z", [[10.0], [-10.0]], degrees=True).as_matrix()
    estimate = truth.copy()
    estimate[:, :3, :3] = turns @ truth[:, :3, :3]
    metrics = evaluate_trajectory(ELSEWHERE_2D @ estimate, truth)
    assert metrics["rotation_error_mean_deg"] == pytest.approx(10.0)
    # Seen from the first pose, the second is turned by 20 degrees too much.
    assert metrics["rpe_rotation_rmse_deg"] == pytest.approx(20.0)


def test_points_feel_rotations_that_positions_do_not():
    """Scans turned by +2 and -2 degrees about their sensors in turn: 2 sin(1 deg) per unit of range."""
    truth = np.tile(winding_path(1, planar=True), (20, 1, 1))
    turns = Rotation.from_euler("z", np.tile([[2.0], [-2.0]], (10, 1)), degrees=True)
    estimate = truth @ poses_from(turns, np.zeros((20, 3)))
    metrics = evaluate_trajectory(estimate, truth, [np.array([[3.0, 0.0], [-3.0, 0.0]])] * 20)
    assert metrics["ape_rmse"] < 1e-12
    assert metrics["point_rms_displacement"] == pytest.approx(3 * 2 * np.sin(np.deg2rad(1)))


def test_a_map_turned_as_a_whole_is_no_displacement():
    """A straight path, shaken by a hair, leaves the roll about it to chance; the points far from it do not."""
    truth, estimate = straight_path(10), straight_path(10)
    estimate[:, 1, 3] += 1e-3 * np.where(np.arange(10) % 2, 1, -1)
    scans = [50 * np.random.default_rng(0).normal(size=(30, 3))] * 10
    assert evaluate_trajectory(ELSEWHERE @ estimate, truth, scans)["point_rms_displacement"] < 1.1e-3


def test_planar_poses_may_come_as_three_by_three():
    truth, estimate = winding_path(12, planar=True), winding_path(12, planar=True, noise=0.1)
    keep = np.ix_(range(12), [0, 1, 3], [0, 1, 3])
    assert evaluate_trajectory(estimate[keep], truth[keep]) == pytest.approx(evaluate_trajectory(estimate, truth))


def test_a_plane_is_not_turned_over():
    """The mirror image of a planar path stays wrong, although turning it over in space would hide that."""
    truth = winding_path(30, planar=True)
    mirrored = truth.copy()
    mirrored[:, 1, 3] *= -1
    assert evaluate_trajectory(mirrored, truth)["ape_rmse"] > 0.3


@pytest.mark.parametrize("k", [1, 2, 6])
def test_a_straight_line_is_aligned_by_its_orientations(k):
    """Positions on a line leave the roll about it open, and a single pose leaves everything open."""
    truth = straight_path(k, roll=0.4)
    metrics = evaluate_trajectory(ELSEWHERE @ truth, truth, [np.random.default_rng(0).normal(size=(9, 3))] * k)
    assert max(metrics.values()) < 1e-5


def test_curves_agree_with_the_summary():
    truth, estimate = winding_path(30), winding_path(30, noise=0.05)
    position, rotation_deg = pose_errors(estimate, truth)
    metrics = evaluate_trajectory(estimate, truth)
    assert np.sqrt(np.mean(position**2)) == pytest.approx(metrics["ape_rmse"])
    assert np.mean(rotation_deg) == pytest.approx(metrics["rotation_error_mean_deg"])


def broken(change) -> np.ndarray:
    poses = winding_path(4)
    change(poses)
    return poses


@pytest.mark.parametrize(
    ("estimate", "words"),
    [
        (winding_path(4)[0], "estimate has shape"),
        (winding_path(4)[:0], "at least one pose"),
        (winding_path(3), "estimate has 3 poses and truth has 4"),
        (broken(lambda poses: poses.__setitem__((2, 0, 3), np.nan)), "first in pose 2"),
        (broken(lambda poses: poses.__setitem__((1, slice(3), 0), 5.0)), "pose 1 is no rigid motion"),
    ],
)
def test_bad_poses_are_refused_in_words(as_a_user, estimate, words):
    with pytest.raises(ValueError, match=words):
        evaluate_trajectory(estimate, winding_path(4))


def test_wrong_number_of_scans_is_refused():
    with pytest.raises(ValueError, match="3 scans for 4 poses"):
        evaluate_trajectory(winding_path(4), winding_path(4), [np.zeros((1, 3))] * 3)


def test_poses_written_with_six_digits_are_taken_for_the_rotations_they_mean(rng):
    exact = np.tile(np.eye(4), (6, 1, 1))
    exact[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(6, 3))).as_matrix()
    exact[:, :3, 3] = rng.normal(size=(6, 3))
    written = exact.round(6) * 1.0
    written[:, :3, :3] *= 1 + 2e-6
    errors = evaluate_trajectory(exact, written)
    assert errors["ape_rmse"] < 1e-5
    assert errors["rpe_rotation_rmse_deg"] < 1e-3


def test_positions_come_before_orientations_however_short_the_path():
    truth, estimate = straight_path(5), straight_path(5)
    truth[:, :3, 3] *= 1e-3
    estimate[:, :3, 3] = truth[:, [1, 0, 2], 3]  # along y, the orientations left as they were
    assert evaluate_trajectory(ELSEWHERE @ estimate, ELSEWHERE @ truth)["ape_max"] < 1e-7


def test_orientations_are_never_compared_in_a_mirror():
    truth = straight_path(3)
    halves = poses_from(Rotation.from_rotvec(np.pi * np.eye(3)), truth[:, :3, 3])  # their sum is a reflection
    np.testing.assert_allclose(np.sort(pose_errors(halves, truth)[1]), [0, 180, 180], atol=1e-6)
