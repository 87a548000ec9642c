"""Poses of scans as arrays: checked, and those of the plane embedded in space.

A pose is ``world_from_scan``; 2D poses may come as ``(k, 3, 3)`` or, as files hold them, embedded in ``(k, 4, 4)``
with z = 0.
"""

import numpy as np
from jaxtyping import Float

# How far R^T R may be from the identity before a matrix is refused as a rotation; files hold 6 digits.
ROTATION_TOLERANCE = 1e-3


def check_same_number(estimate: np.ndarray, truth: np.ndarray) -> None:
    """Refuse trajectories of different lengths."""
    if len(estimate) != len(truth):
        raise ValueError(f"estimate has {len(estimate)} poses and truth has {len(truth)}; give the same scans in both")


def checked_poses(poses: Float[np.ndarray, "k m m"], name: str) -> Float[np.ndarray, "k 4 4"]:
    """The poses as float64 ``(k, 4, 4)``, their rotations orthogonal to the last digit.

    Raises
    ------
    ValueError: another shape, no pose, not finite, or not rigid motions.
    """
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] not in ((3, 3), (4, 4)) or len(poses) == 0:
        raise ValueError(f"{name} has shape {poses.shape}; give at least one pose as (k, 4, 4) or (k, 3, 3)")
    if not np.isfinite(poses).all():
        raise ValueError(f"{name} is not finite, first in pose {np.argwhere(~np.isfinite(poses))[0, 0]}")
    if poses.shape[1] == 3:
        poses = embed_poses(poses)
    rotation = poses[:, :3, :3]
    skew = np.abs(np.swapaxes(rotation, 1, 2) @ rotation - np.eye(3)).max(axis=(1, 2))
    wrong = (skew > ROTATION_TOLERANCE) | (np.linalg.det(rotation) < 0)
    if wrong.any():
        raise ValueError(f"{name}: pose {np.argmax(wrong)} is no rigid motion; orthogonalise its rotation")
    # Files with six digits leave rotations 1e-6 off orthogonal, which evo refuses: the nearest rotation is meant.
    left, _, right = np.linalg.svd(rotation)
    poses = poses.copy()
    poses[:, :3, :3] = left @ right
    return poses


def embed_poses(poses: Float[np.ndarray, "k m m"]) -> Float[np.ndarray, "k 4 4"]:
    """2D poses ``(k, 3, 3)`` as ``(k, 4, 4)`` in the plane z = 0; 3D poses pass unchanged."""
    if poses.shape[1] == 4:
        return poses
    embedded = np.tile(np.eye(4), (len(poses), 1, 1))
    embedded[:, :2, :2], embedded[:, :2, 3] = poses[:, :2, :2], poses[:, :2, 2]
    return embedded
