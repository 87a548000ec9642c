"""Trajectories in files: TUM, KITTI and .npz, always as ``world_from_scan``, ``(k, 4, 4)``, also in 2D."""

import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bbr_layer.atomic import atomic_write, existing_file

TUM_COLUMNS = 8  # timestamp tx ty tz qx qy qz qw
KITTI_COLUMNS = 12  # the upper three rows of the matrix, row by row
POSE_KEYS = ("poses", "world_from_scan")  # what an .npz calls its poses, the first one found
# What KITTI and its relatives call the transform from the velodyne's frame to the camera's.
CALIBRATION_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")
# A rotation matrix in a file is one within this: KITTI writes seven digits, hand-made files fewer.
ORTHOGONAL_TOLERANCE = 1e-3


def write_poses_tum(
    path: str | Path, world_from_scan: Float[np.ndarray, "k 4 4"], timestamps: Float[np.ndarray, "k"]
) -> None:
    """Write ``timestamp tx ty tz qx qy qz qw`` a line, digits enough to read the same numbers back.

    Raises
    ------
    ValueError: poses of another shape, not rigid or not finite, or another number of timestamps.
    OSError: the file cannot be written; nothing of it is left.
    """
    poses, times = _checked("world_from_scan", world_from_scan), np.asarray(timestamps, dtype=np.float64)
    if times.shape != poses.shape[:1]:
        raise ValueError(f"timestamps have shape {times.shape} and there are {len(poses)} poses; give one each")
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    _write_rows(path, np.column_stack((times, poses[:, :3, 3], quaternions)))


def read_poses_tum(path: str | Path) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k 4 4"]]:
    """Timestamps in seconds and ``world_from_scan`` of a TUM file; ``#`` begins a comment.

    Raises
    ------
    FileNotFoundError, ValueError: no such file; no TUM trajectory in it.
    """
    rows = _read_rows(path, TUM_COLUMNS, "TUM (timestamp tx ty tz qx qy qz qw)")
    if (np.linalg.norm(rows[:, 4:], axis=1) == 0).any():
        raise ValueError(f"{path} holds a quaternion of zeros, which is no rotation: 0 0 0 1 is none at all")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    poses[:, :3, 3] = rows[:, 1:4]
    return rows[:, 0], poses


def write_poses_kitti(path: str | Path, world_from_scan: Float[np.ndarray, "k 4 4"]) -> None:
    """Write the upper three rows of each matrix as one line of twelve numbers, in the scans' own frame.

    Raises
    ------
    ValueError: poses of another shape, not rigid or not finite.
    OSError: the file cannot be written; nothing of it is left.
    """
    _write_rows(path, _checked("world_from_scan", world_from_scan)[:, :3].reshape(-1, KITTI_COLUMNS))


def read_poses_kitti(path: str | Path, calib: str | Path | None = None) -> Float[np.ndarray, "k 4 4"]:
    """Poses of a KITTI file; with its ``calib.txt`` those of the velodyne, without it those of the camera.

    KITTI's poses P_i move the camera. With the calibration ``Tr`` (camera from velodyne) the scans' are
    ``world_from_scan_i = inv(Tr) @ P_i @ Tr``.

    Raises
    ------
    FileNotFoundError, ValueError: no such file; no KITTI trajectory in it; a calibration without ``Tr``.
    """
    rows = _read_rows(path, KITTI_COLUMNS, "KITTI (twelve numbers a line)")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    poses = _checked(str(path), poses)
    if calib is None:
        return poses
    camera_from_velodyne = _read_calibration(calib)
    return np.linalg.inv(camera_from_velodyne) @ poses @ camera_from_velodyne


def read_poses(path: str | Path) -> Float[np.ndarray, "k 4 4"]:
    """``world_from_scan`` from a file, its format told by its content.

    8 columns are TUM, 12 are KITTI (taken as they are, see ``read_poses_kitti``), and an .npz holds ``poses``
    or ``world_from_scan``, ``(k, 4, 4)`` or, in 2D, ``(k, 3, 3)``.

    Raises
    ------
    FileNotFoundError, ValueError: no such file; none of these formats.
    """
    found = existing_file(path)
    if found.suffix.lower() == ".npz":
        return _read_poses_npz(found)
    columns = _first_row_length(found)
    if columns == TUM_COLUMNS:
        return read_poses_tum(found)[1]
    if columns == KITTI_COLUMNS:
        return read_poses_kitti(found)
    raise ValueError(f"{path} has {columns} numbers a line; a trajectory has 8 (TUM) or 12 (KITTI)")


def read_motion(path: str | Path) -> Float[np.ndarray, "4 4"]:
    """One rigid motion from a text file of 4 x 4 numbers; or of 3 x 3, a motion in the plane z = 0.

    Raises
    ------
    FileNotFoundError, ValueError: no such file; no rigid motion in it.
    """
    try:
        matrix = np.loadtxt(existing_file(path), ndmin=2, encoding="utf-8-sig")
    except ValueError as error:
        raise ValueError(f"{path} is no rigid motion of 4 x 4 numbers: {error}") from error
    if matrix.shape == (3, 3):
        return _embedded(str(path), matrix[None])[0]
    return _checked(str(path), matrix[None])[0]


def _read_poses_npz(path: Path) -> np.ndarray:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            key = next((key for key in POSE_KEYS if key in arrays.files), None)
            if key is None:
                raise ValueError(f"it holds {', '.join(arrays.files)}; an array named {POSE_KEYS[0]} is wanted")
            poses = arrays[key].astype(np.float64)
    except (ValueError, AttributeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} cannot be read as a trajectory: {error}") from error
    return _embedded(str(path), poses) if poses.shape[1:] == (3, 3) else _checked(str(path), poses)


def _embedded(name: str, poses: np.ndarray) -> np.ndarray:
    """Motions of the plane, ``(k, 3, 3)``, as motions of space."""
    spatial = np.tile(np.eye(4), (len(poses), 1, 1))
    spatial[:, :2, :2], spatial[:, :2, 3] = poses[:, :2, :2], poses[:, :2, 2]
    return _checked(name, spatial)


def _checked(name: str, poses: np.ndarray) -> np.ndarray:
    poses = np.asarray(poses, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
        raise ValueError(f"{name} has poses of shape {poses.shape}; (k, 4, 4) is wanted, k at least 1")
    if not np.isfinite(poses).all():
        raise ValueError(f"{name} has poses that are NaN or infinite: leave those scans out")
    rotations = poses[:, :3, :3]
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = (off > ORTHOGONAL_TOLERANCE) | (np.linalg.det(rotations) < 0)
    if wrong.any():
        raise ValueError(f"{name} has a pose that is no rigid motion (the first is number {wrong.argmax()})")
    return poses


def _first_row_length(path: Path) -> int:
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        rows = (line.split("#")[0].split() for line in file)
        return next((len(row) for row in rows if row), 0)


def _read_rows(path: str | Path, columns: int, wanted: str) -> np.ndarray:
    found = existing_file(path)
    if _first_row_length(found) != columns:
        raise ValueError(f"{path} is no trajectory as {wanted}: its first row has another number of columns")
    try:
        rows = np.loadtxt(found, ndmin=2, encoding="utf-8-sig")
    except ValueError as error:
        raise ValueError(f"{path} is no trajectory as {wanted}: {error}") from error
    if not np.isfinite(rows).all():
        raise ValueError(f"{path} holds numbers that are NaN or infinite: leave those scans out")
    return rows


def _write_rows(path: str | Path, rows: Iterable[np.ndarray]) -> None:
    with atomic_write(path) as temporary:
        # repr gives the fewest digits that read back as the same number
        temporary.write_text("".join(" ".join(map(repr, row.tolist())) + "\n" for row in rows))


def _read_calibration(path: str | Path) -> Float[np.ndarray, "4 4"]:
    for line in existing_file(path).read_text(encoding="utf-8-sig", errors="replace").splitlines():
        key, _, numbers = line.partition(":")
        if key.strip() in CALIBRATION_KEYS and len(numbers.split()) == KITTI_COLUMNS:
            matrix = np.eye(4)
            matrix[:3] = np.array(numbers.split(), dtype=np.float64).reshape(3, 4)
            return matrix
    raise ValueError(f"{path} has no line 'Tr:' of twelve numbers, the camera's frame from the velodyne's")
