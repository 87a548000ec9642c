"""Point clouds from files: one door for every format, and folders of scans in natural order."""

import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import plyfile
from jaxtyping import Float

from bbr_layer.atomic import existing_file
from bbr_layer.cloud_columns import Columns, lengths
from bbr_layer.cloud_formats import read_las, read_mesh, read_pcd, read_ply
from bbr_layer.cloud_tables import read_bin, read_npy, read_npz, read_npz_sequence, read_text
from bbr_layer.file_names import is_companion, natural_key

# Formats made for points and meshes; a folder that holds any of them is read by them alone.
CLOUD_READERS: dict[str, Callable[[Path], Columns]] = {
    ".ply": read_ply,
    ".pcd": read_pcd,
    ".bin": read_bin,
    ".las": read_las,
    ".laz": read_las,
    ".obj": read_mesh,
    ".stl": read_mesh,
    ".off": read_mesh,
}
# Formats that hold anything: in a folder, files named like a trajectory or a calibration are no scans.
TABLE_READERS: dict[str, Callable[[Path], Columns]] = {
    ".npz": read_npz,
    ".npy": read_npy,
    ".xyz": read_text,
    ".txt": read_text,
    ".csv": read_text,
}
READERS = CLOUD_READERS | TABLE_READERS
REASON_CHARACTERS = 200  # of a library's message or of file names; the rest is lists of more of the same
KITTI_SCANS = "velodyne"  # the folder of scans inside a KITTI sequence
# What the libraries raise at files that are damaged, locked or no such format: ImportError is trimesh's on
# undecodable text, MemoryError and OverflowError come of absurd counts in a header, the last of archives.
UNREADABLE = (
    *(OSError, ValueError, TypeError, LookupError, RuntimeError, EOFError, ImportError, MemoryError),
    *(
        OverflowError,
        struct.error,
        zipfile.BadZipFile,
        zlib.error,
        tokenize.TokenError,
        plyfile.PlyParseError,
    ),
)


@dataclass(frozen=True)
class Cloud:
    """A point cloud as a file holds it.

    Parameters
    ----------
    points: ``(n, d)`` float64, d = 2 or 3, in the file's unit and frame; all finite.
    normals: ``(n, d)`` float64 of unit length, or None if the file has none or lacks some.
    intensity: ``(n,)`` float64 in the sensor's unit, or None.
    dropped: how many points of the file were left out for NaN or infinite coordinates (returns of nothing).
    """

    points: Float[np.ndarray, "n d"]
    normals: Float[np.ndarray, "n d"] | None = None
    intensity: Float[np.ndarray, "n"] | None = None
    dropped: int = 0


def read_cloud(path: str | Path) -> Cloud:
    """Read one point cloud, its format chosen by its suffix.

    .ply .pcd .bin (KITTI, nuScenes) .las .laz .npz .npy .xyz .txt .csv, and the vertices of .obj .stl .off (see
    ``sample_surface`` for points on the faces). Tables of two columns, and those without z, give a 2D cloud.

    Raises
    ------
    FileNotFoundError: there is no such file.
    ValueError: an unknown suffix, a damaged file, or no finite point in it.
    """
    found = existing_file(path)
    reader = READERS.get(found.suffix.lower())
    if reader is None:
        raise ValueError(f"{path} has the suffix {found.suffix!r}; readable are {' '.join(READERS)}")
    try:
        columns = reader(found)
    except UNREADABLE as error:
        raise ValueError(f"{path} cannot be read as {found.suffix}: {_reason(error)}") from error
    return _finite_cloud(path, columns)


def sample_surface(path: str | Path, count: int, *, seed: int = 0) -> Cloud:
    """Points drawn evenly from the faces of a mesh (.ply .obj .stl .off), ``(count, 3)``, with normals.

    Raises
    ------
    FileNotFoundError: there is no such file.
    ValueError: it is no mesh, has no faces, or the count is not positive.
    """
    import trimesh

    found = existing_file(path)
    if count < 1:
        raise ValueError(f"count is {count}; at least one point must be drawn")
    if READERS.get(found.suffix.lower()) not in (read_ply, read_mesh):
        raise ValueError(f"{path} is no mesh; .ply .obj .stl and .off are")
    try:
        mesh = trimesh.load_scene(found, process=False).to_mesh()
    except UNREADABLE as error:
        raise ValueError(f"{path} cannot be read as {found.suffix}: {_reason(error)}") from error
    if len(mesh.faces) == 0 or mesh.area == 0:
        raise ValueError(f"{path} has no faces to draw points from: read_cloud reads its vertices")
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return Cloud(np.asarray(points, dtype=np.float64), normals=np.asarray(mesh.face_normals[faces]))


def scan_paths(folder: str | Path) -> list[Path]:
    """The scans in a folder in natural order (2 before 10); in a KITTI sequence, those in its ``velodyne``.

    Raises
    ------
    FileNotFoundError: there is no such folder, or no scan in it but by their names other tables.
    """
    found = Path(folder)
    if not found.is_dir():
        raise FileNotFoundError(f"{folder} is not a folder: check the name, and the folder it is seen from")
    files = sorted((file for file in found.iterdir() if _visible_file(file)), key=natural_key)
    tables = [file for file in files if file.suffix.lower() in TABLE_READERS and not is_companion(file)]
    scans = [file for file in files if file.suffix.lower() in CLOUD_READERS] or tables
    if not scans and (found / KITTI_SCANS).is_dir():
        return scan_paths(found / KITTI_SCANS)
    if not scans:
        others = ", ".join(file.name for file in files if file.suffix.lower() in TABLE_READERS)
        named = f"; by their names {others[:REASON_CHARACTERS]} are none: name such files one by one" if others else ""
        raise FileNotFoundError(f"{folder} holds no scans; files ending {' '.join(READERS)} are wanted{named}")
    return scans


def read_scans(source: str | Path | Sequence[str | Path]) -> list[Cloud]:
    """Read a folder of scans, a list of files, or one .npz of several scans (``points`` cut at ``offsets``).

    Raises
    ------
    FileNotFoundError, ValueError: as ``scan_paths`` and ``read_cloud``; an empty list; wrong offsets.
    """
    if not isinstance(source, str | Path):
        if not source:
            raise ValueError("the list of scans is empty; name at least one file")
        return [read_cloud(path) for path in source]
    if Path(source).suffix.lower() == ".npz":
        return _read_sequence(existing_file(source))
    return [read_cloud(path) for path in scan_paths(source)]


def _read_sequence(path: Path) -> list[Cloud]:
    try:
        parts = read_npz_sequence(path)
    except UNREADABLE as error:
        raise ValueError(f"{path} is no .npz of several scans, with points and offsets: {_reason(error)}") from error
    return [_finite_cloud(f"{path}, scan {i}", part) for i, part in enumerate(parts)]


def _finite_cloud(name: str | Path, columns: Columns) -> Cloud:
    finite = np.isfinite(columns.points).all(axis=1)
    if not finite.any():
        raise ValueError(f"{name} holds no finite point ({len(finite)} in all): nothing to register")
    normals = columns.normals[finite] if columns.normals is not None else None
    if normals is not None:
        length = lengths(normals)
        usable = bool((np.isfinite(length) & (length > 0)).all())
        normals = normals / length[:, None] if usable else None
    intensity = None if columns.intensity is None else columns.intensity[finite]
    return Cloud(columns.points[finite], normals, intensity, int((~finite).sum()))


def _reason(error: BaseException) -> str:
    """What a library says, in one line."""
    return " ".join(str(error).split())[:REASON_CHARACTERS] or type(error).__name__


def _visible_file(path: Path) -> bool:
    return path.is_file() and not path.name.startswith(".")
