"""How good a trajectory and a map are: APE and RPE as ``evo`` defines them, point displacement.

Lengths are in the data's own unit; poses are those of ``train/poses.py``.
"""

from collections.abc import Sequence

import numpy as np
from evo.core.geometry import GeometryException, umeyama_alignment
from evo.core.metrics import APE, PE, RPE, PoseRelation, StatisticsType
from evo.core.trajectory import PosePath3D
from evo.core.units import Unit
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from train.poses import check_same_number, checked_poses

# Tilt (radians) and height (share of the largest coordinate) of poses that count as planar: rounding in float64.
PLANE_TOLERANCE = 1e-9
# Weight of the orientations, relative to the spread of the path, where positions leave the alignment open.
TIE_BREAK = 1e-6


def evaluate_trajectory(
    estimate: Float[np.ndarray, "k m m"],
    truth: Float[np.ndarray, "k m m"],
    points: Sequence[Float[np.ndarray, "_ d"]] | None = None,
) -> dict[str, float]:
    """Errors of an estimated trajectory against the truth.

    Absolute errors come after the rigid alignment without scale of ``align_trajectories`` (``evo_ape -a``);
    relative errors are over consecutive poses (``evo_rpe -d 1 -u f``), 0 for a single pose.
    Source: J. Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012, as evo reads it.

    Parameters
    ----------
    estimate, truth: ``world_from_scan``, ``(k, 4, 4)`` or in 2D ``(k, 3, 3)``, the same k scans in one order.
    points: the k scans ``(n_i, d)``, each in its own sensor frame.

    Returns
    -------
    ``ape_rmse``, ``ape_mean``, ``ape_median``, ``ape_max``: distance between positions.
    ``rpe_translation_rmse``, ``rpe_rotation_rmse_deg``. ``rotation_error_mean_deg``: mean angle between
    orientations after the common rotation that brings them closest; positions play no part.
    ``point_rms_displacement``, where ``points`` are given: how far a point stands from where it should, after
    the rigid motion of the map that brings the points themselves closest.

    Raises
    ------
    ValueError: shapes that do not match, no pose, not finite, or not rigid motions.
    """
    estimate, truth = checked_poses(estimate, "estimate"), checked_poses(truth, "truth")
    aligned = align_trajectories(estimate, truth) @ estimate
    errors = _metric(APE(PoseRelation.translation_part), aligned, truth).get_all_statistics()
    metrics = {f"ape_{name}": errors[name] for name in ("rmse", "mean", "median", "max")}
    metrics |= {
        "rpe_translation_rmse": _relative_rmse(estimate, truth, PoseRelation.translation_part),
        "rpe_rotation_rmse_deg": _relative_rmse(estimate, truth, PoseRelation.rotation_angle_deg),
        "rotation_error_mean_deg": float(np.mean(_rotation_errors_deg(estimate, truth))),
    }
    if points is not None:
        metrics["point_rms_displacement"] = point_rms_displacement(estimate, truth, points)
    return {name: float(value) for name, value in metrics.items()}


def align_trajectories(
    estimate: Float[np.ndarray, "k m m"], truth: Float[np.ndarray, "k m m"]
) -> Float[np.ndarray, "4 4"]:
    """The rigid motion ``truth_from_estimate`` ``(4, 4)``, without scale, that brings the positions closest.

    Umeyama's least squares as ``evo`` does it, with two additions. Planar trajectories (z = 0) are aligned within
    their plane: turning the plane over, which ``evo`` would consider for a mirror image, is no motion of theirs.
    Where the positions leave a rotation open (one pose, a standing sensor, a straight line in 3D, all refused by
    ``evo``), the orientations decide it.
    """
    estimate, truth = checked_poses(estimate, "estimate"), checked_poses(truth, "truth")
    check_same_number(estimate, truth)
    d = 2 if _is_planar(estimate) and _is_planar(truth) else 3
    source, target = estimate[:, :d, 3], truth[:, :d, 3]
    try:
        rotation, translation, _ = umeyama_alignment(source.T, target.T)
    except GeometryException:
        rotation = _rotation_with_tie_break(estimate[:, :d], truth[:, :d])
        translation = target.mean(axis=0) - rotation @ source.mean(axis=0)
    motion = np.eye(4)
    motion[:d, :d], motion[:d, 3] = rotation, translation
    return motion


def pose_errors(
    estimate: Float[np.ndarray, "k m m"], truth: Float[np.ndarray, "k m m"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """Position error (data's unit) and rotation error (degrees) of each pose, for curves.

    The means of squares and of angles are ``evaluate_trajectory``'s ``ape_rmse`` and
    ``rotation_error_mean_deg``.
    """
    estimate, truth = checked_poses(estimate, "estimate"), checked_poses(truth, "truth")
    aligned = align_trajectories(estimate, truth) @ estimate
    position = _metric(APE(PoseRelation.translation_part), aligned, truth).error
    return np.asarray(position), _rotation_errors_deg(estimate, truth)


def point_rms_displacement(
    estimate: Float[np.ndarray, "k 4 4"],
    truth: Float[np.ndarray, "k 4 4"],
    points: Sequence[Float[np.ndarray, "_ d"]],
) -> float:
    """Root mean square distance between the scanned points placed by ``estimate`` and by ``truth``.

    After the rigid motion that makes it smallest: positions on a nearly straight path would leave the roll about it
    to their noise, and points far from the path magnify that.
    """
    if len(points) != len(truth) or not any(len(scan) for scan in points):
        raise ValueError(f"points: {len(points)} scans for {len(truth)} poses; give each pose a scan with points")
    source, target = _centred(estimate, points), _centred(truth, points)
    rotation = _nearest_rotation(target.T @ source)
    return float(np.sqrt(np.mean(np.sum((source @ rotation.T - target) ** 2, axis=1))))


def _centred(poses: np.ndarray, points: Sequence[np.ndarray]) -> np.ndarray:
    """All points carried by their scans' poses, about their mean."""
    d = points[0].shape[1]
    placed = np.concatenate([scan @ pose[:d, :d].T + pose[:d, 3] for scan, pose in zip(points, poses, strict=True)])
    return placed - placed.mean(axis=0)


def _metric(metric: PE, estimate: np.ndarray, truth: np.ndarray) -> PE:
    paths = PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))
    metric.process_data(paths)
    return metric


def _relative_rmse(estimate: np.ndarray, truth: np.ndarray, relation: PoseRelation) -> float:
    if len(estimate) < 2:
        return 0.0
    metric = _metric(RPE(relation, delta=1, delta_unit=Unit.frames), estimate, truth)
    return metric.get_statistic(StatisticsType.rmse)


def _rotation_errors_deg(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    common = _nearest_rotation(np.einsum("kij,klj->il", truth[:, :3, :3], estimate[:, :3, :3]))
    relative = np.swapaxes(truth[:, :3, :3], 1, 2) @ common @ estimate[:, :3, :3]
    return np.rad2deg(Rotation.from_matrix(relative).magnitude())


def _rotation_with_tie_break(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The rotation aligning positions first and, as far as they leave it open, orientations."""
    source, target = (path[:, :, 3] - path[:, :, 3].mean(axis=0) for path in (estimate, truth))
    orientations = np.einsum("kij,klj->il", truth[:, :, : truth.shape[1]], estimate[:, :, : truth.shape[1]])
    spread = np.linalg.norm(source) * np.linalg.norm(target)
    weight = TIE_BREAK * spread / len(estimate) if spread > 0 else 1.0
    return _nearest_rotation(target.T @ source + weight * orientations)


def _nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    u, _, v = np.linalg.svd(matrix)
    signs = np.ones(len(matrix))
    signs[-1] = np.sign(np.linalg.det(u @ v))
    return (u * signs) @ v


def _is_planar(poses: np.ndarray) -> bool:
    tilt, height = np.abs(poses[:, 2, :2]).max(), np.abs(poses[:, 2, 3]).max()
    return bool(tilt <= PLANE_TOLERANCE and height <= PLANE_TOLERANCE * np.abs(poses[:, :2, 3]).max())
