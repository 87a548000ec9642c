"""The scans of one run with their names, starting poses and truth, and how they are read from files."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bbr_layer import read_cloud, read_poses, read_scans, scan_paths
from train.scan_checks import check_scan, listed, without_far_points, without_height

# Told a stage, how much of it is done, and of how much.
Progress = Callable[[str, int, int], None]
# Share of the largest entry by which a planar pose may leave its plane: files hold about 6 digits.
PLANE_TOLERANCE = 1e-5


def silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


@dataclass(frozen=True)
class ScanSet:
    """k scans, each in its own sensor frame with the sensor at the origin.

    Parameters
    ----------
    points: k arrays ``(n_i, d)`` float64 in the data's unit, d = 2 or 3, each with at least
        ``FEWEST_POINTS`` different ones off the origin.
    names: k names, for messages.
    timestamps: ``(k,)`` seconds, or the number of the scan.
    start: ``world_from_scan`` given by the user, ``(k, d + 1, d + 1)``; None: not known.
    truth: the true ``world_from_scan``, for the report only; None: not known.
    notes: what was done to the scans when they were read, in sentences for the user.

    Raises
    ------
    ValueError: fewer than 2 scans, mixed dimensions, numbers that do not fit together, or as ``check_scan``.
    """

    points: list[Float[np.ndarray, "_ d"]]
    names: list[str]
    timestamps: Float[np.ndarray, " k"]
    start: Float[np.ndarray, "k d1 d1"] | None = None
    truth: Float[np.ndarray, "k d1 d1"] | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        k = len(self.points)
        if k < 2:
            raise ValueError(f"{k} scan was given; a map needs at least 2: name more files or lower the stride")
        if len(self.names) != k or self.timestamps.shape != (k,):
            raise ValueError(f"{k} scans came with {len(self.names)} names and {len(self.timestamps)} timestamps")
        for name, scan in zip(self.names, self.points, strict=True):
            if scan.ndim != 2 or scan.shape[1] != self.dimension or scan.shape[1] not in (2, 3):
                raise ValueError(f"scan {name} has shape {scan.shape}; all scans must be (n, 2), or all (n, 3)")
            check_scan(name, scan)
        side = self.dimension + 1
        for role, poses in (("start", self.start), ("truth", self.truth)):
            if poses is not None and poses.shape != (k, side, side):
                raise ValueError(f"{role} has shape {poses.shape}; {k} scans need {(k, side, side)}")

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.points[0].shape[1])

    def __len__(self) -> int:
        return len(self.points)

    def fingerprint(self) -> str:
        """The same for the same points and starting poses, whatever their files are called."""
        return self._digest(*(() if self.start is None else (self.start,)))

    def points_fingerprint(self) -> str:
        """The same for the same points, wherever the scans stand."""
        return self._digest()

    def _digest(self, *others: np.ndarray) -> str:
        digest = hashlib.sha256(str([scan.shape for scan in self.points]).encode())
        for array in (*self.points, *others):
            digest.update(np.ascontiguousarray(array, dtype=np.float64).tobytes())
        return digest.hexdigest()


def read_scan_set(
    sources: Sequence[Path],
    *,
    start: Path | None = None,
    truth: Path | None = None,
    stride: int = 1,
    progress: Progress = silent,
) -> ScanSet:
    """Read a folder of scans, several files, or one .npz of several scans.

    Scans are planar (d = 2) when every z of every scan is missing or the same. Points too far to have been seen are
    left out. ``notes`` of the answer tells of both, and of files in the folder that are called like something else.

    Parameters
    ----------
    sources: one folder, one ``.npz`` with ``points`` and ``offsets``, or the scan files in their order.
    start, truth: files of poses, one for each scan before or after the stride.
    stride: keep every how many-th scan.
    progress: told each scan.

    Raises
    ------
    FileNotFoundError, ValueError: as ``scan_paths``, ``read_cloud``, ``read_poses``, ``without_far_points`` and
        ``ScanSet``; poses of another number.
    """
    if not sources or stride < 1:
        raise ValueError(f"{len(sources)} sources and stride {stride} were given; both must be at least 1")
    scans, names, total = _read_points(sources, stride, progress)
    scans, unseen = without_far_points(scans, names)
    scans, dropped = without_height(scans)
    flat = scans[0].shape[1] == 2
    poses = {
        role: None if path is None else _read_trajectory(role, path, (total, stride), flat)
        for role, path in (("start", start), ("truth", truth))
    }
    timestamps = np.arange(total, dtype=np.float64)[::stride]
    notes = (*_passed_over(sources), *unseen, *dropped)
    return ScanSet(scans, names, timestamps, start=poses["start"], truth=poses["truth"], notes=notes)


def _read_points(sources: Sequence[Path], stride: int, progress: Progress) -> tuple[list[np.ndarray], list[str], int]:
    """Points and names of the kept scans, and how many scans there were."""
    if len(sources) == 1 and sources[0].suffix.lower() == ".npz":
        clouds = read_scans(sources[0])
        names = [f"{sources[0].name}[{number}]" for number in range(len(clouds))]
        return [cloud.points for cloud in clouds[::stride]], names[::stride], len(clouds)
    paths = scan_paths(sources[0]) if len(sources) == 1 and not sources[0].is_file() else list(sources)
    kept = paths[::stride]
    scans = []
    for number, path in enumerate(kept):
        scans.append(read_cloud(path).points)
        progress("reading", number + 1, len(kept))
    return scans, [path.name for path in kept], len(paths)


def _passed_over(sources: Sequence[Path]) -> list[str]:
    """A sentence on the files in a folder of scans that end like them but are called like something else."""
    if len(sources) != 1 or not sources[0].is_dir():
        return []
    read = scan_paths(sources[0])
    kinds = {path.suffix.lower() for path in read}
    beside = {path for path in read[0].parent.iterdir() if path.suffix.lower() in kinds and path.is_file()} - set(read)
    others = sorted(path.name for path in beside if not path.name.startswith("."))
    return [f"not taken for scans, for their names: {listed(others)}"] if others else []


def _read_trajectory(role: str, path: Path, scans: tuple[int, int], flat: bool) -> np.ndarray:
    """Poses of the kept scans, ``(k, d + 1, d + 1)``; ``scans``: how many there were, and the stride."""
    total, stride = scans
    kept = -(-total // stride)
    poses = read_poses(path)
    if len(poses) not in (total, kept):
        wanted = f"{total}" if total == kept else f"{total} or, after the stride, {kept}"
        raise ValueError(f"{role}: {path} holds {len(poses)} poses; the scans need {wanted}")
    poses = poses[::stride] if len(poses) == total else poses
    return planar_poses(poses, f"{role}: {path}") if flat else poses


def planar_poses(poses: Float[np.ndarray, "k 4 4"], name: str) -> Float[np.ndarray, "k 3 3"]:
    """Poses in the plane z = 0 as ``(k, 3, 3)``.

    Raises
    ------
    ValueError: a pose that leaves the plane.
    """
    off_plane = np.concatenate((poses[:, 2, :2], poses[:, :2, 2], poses[:, 2, 3:]), axis=1)
    if np.abs(off_plane).max() > PLANE_TOLERANCE * np.abs(poses).max():
        raise ValueError(f"{name} leaves the plane z = 0, but the scans are planar: give poses about z")
    return poses[:, [0, 1, 3]][:, :, [0, 1, 3]]
