"""Point clouds into files: .ply .pcd .npz .csv .xyz, whole or not at all."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from jaxtyping import Float, UInt8

from bbr_layer.atomic import atomic_write

AXES = ("x", "y", "z")
COLOURS = ("red", "green", "blue")
# Significant digits that give back the same number: float32, float64.
DIGITS = {4: 9, 8: 17}
PCD_NAMES = {"nx": "normal_x", "ny": "normal_y", "nz": "normal_z"}
RESERVED = frozenset(
    {*AXES, "nx", "ny", "nz", *COLOURS, "points", "normals", "colours", "offsets", "file", "allow_pickle"}
)


def write_cloud(
    path: str | Path,
    points: Float[np.ndarray, "n d"],
    *,
    normals: Float[np.ndarray, "n d"] | None = None,
    columns: Mapping[str, np.ndarray] | None = None,
    colours: UInt8[np.ndarray, "n 3"] | None = None,
) -> None:
    """Write a point cloud; ``read_cloud`` reads it back.

    Parameters
    ----------
    path: .ply (binary), .pcd (binary), .npz, .csv (with a header) or .xyz (the header a ``#`` comment).
    points: ``(n, d)``, d = 2 or 3, n >= 1. Numbers keep their width: float32 is written as such; a .pcd
        holds float32 always, as PCL wants it. 2D points have z = 0 in .ply and .pcd.
    normals: ``(n, d)`` or None.
    columns: further numbers by name, each ``(n,)``, e.g. ``{"intensity": ...}``.
    colours: ``(n, 3)`` red, green and blue from 0 to 255, or None.

    Raises
    ------
    ValueError: an unknown suffix, no points, or columns that do not fit them.
    OSError: the file cannot be written; nothing of it is left.
    """
    writer = writer_of(path)
    fields = _fields(np.asarray(points), normals, colours)
    for name, values in (columns or {}).items():
        if name in RESERVED or not name.isidentifier():
            raise ValueError(f"columns may not hold {name!r}: choose another name of letters and digits")
        fields[name] = _storable(_fitting(name, np.asarray(values), fields["x"].shape))
    with atomic_write(path) as temporary:
        writer(temporary, fields)


def _fields(points: np.ndarray, normals: np.ndarray | None, colours: np.ndarray | None) -> dict[str, np.ndarray]:
    """Columns by name: x y z, nx ny nz, red green blue."""
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) == 0:
        raise ValueError(f"points have shape {points.shape}; rows of 2 or 3 coordinates are wanted")
    axes = AXES[: points.shape[1]]
    fields = dict(zip(axes, _floating(points).T, strict=True))
    if normals is not None:
        normals = _fitting("normals", _floating(np.asarray(normals)), points.shape)
        fields |= {f"n{axis}": column for axis, column in zip(axes, normals.T, strict=True)}
    if colours is not None:
        colours = _fitting("colours", np.asarray(colours), (len(points), 3)).astype(np.uint8)
        fields |= dict(zip(COLOURS, colours.T, strict=True))
    return fields


def _fitting(name: str, values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    if values.shape != shape:
        raise ValueError(f"{name} have shape {values.shape}; {shape} is wanted, one row per point")
    return values


def _floating(values: np.ndarray) -> np.ndarray:
    return values if values.dtype in (np.float32, np.float64) else values.astype(np.float64)


def _storable(values: np.ndarray) -> np.ndarray:
    """A type that every format has: PLY knows neither bool nor 64-bit integers nor half precision."""
    if values.dtype.kind not in "biuf":
        raise ValueError(f"columns hold values of type {values.dtype}; numbers are wanted")
    fitting = (kind for kind in ("u1", "i4", "f4", "f8") if np.can_cast(values.dtype, kind))
    if values.dtype.kind == "i" and values.dtype.itemsize == 8:
        fits = (np.abs(values) <= np.iinfo(np.int32).max).all()
        return values.astype(np.int32 if fits else np.float64)
    return values.astype(next(fitting, "f8"))


def _write_ply(path: Path, fields: dict[str, np.ndarray]) -> None:
    vertex = plyfile.PlyElement.describe(_records(_in_space(fields)), "vertex")
    plyfile.PlyData([vertex], text=False, byte_order="<").write(path)


def _write_pcd(path: Path, fields: dict[str, np.ndarray]) -> None:
    from pypcd4.pypcd4 import Encoding, PointCloud

    named = {
        PCD_NAMES.get(name, name): values.astype(np.float32)
        for name, values in _in_space(fields).items()
        if name not in COLOURS
    }
    if "red" in fields:
        named["rgb"] = PointCloud.encode_rgb(np.stack([fields[name] for name in COLOURS], axis=1))
    cloud = PointCloud.from_points(list(named.values()), list(named), [np.float32] * len(named))
    cloud.save(path, encoding=Encoding.BINARY)


def _write_npz(path: Path, fields: dict[str, np.ndarray]) -> None:
    groups = {"points": AXES, "normals": ("nx", "ny", "nz"), "colours": COLOURS}
    arrays: dict[str, Any] = {
        group: np.stack([fields[name] for name in names if name in fields], axis=1)
        for group, names in groups.items()
        if names[0] in fields
    }
    arrays |= {name: values for name, values in fields.items() if name not in RESERVED}
    np.savez_compressed(path, **arrays)


def _write_csv(path: Path, fields: dict[str, np.ndarray]) -> None:
    header, formats = ",".join(fields), _text_formats(fields)
    np.savetxt(path, _records(fields), fmt=formats, delimiter=",", header=header, comments="")


def _write_xyz(path: Path, fields: dict[str, np.ndarray]) -> None:
    np.savetxt(path, _records(fields), fmt=_text_formats(fields), delimiter=" ", header=" ".join(fields))


def _text_formats(fields: dict[str, np.ndarray]) -> list[str]:
    return [f"%.{DIGITS[v.itemsize]}g" if v.dtype.kind == "f" else "%d" for v in fields.values()]


def _in_space(fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """2D points and normals in 3D, at z = 0."""
    flat = {name: np.zeros_like(fields["x"]) for name in ("z", "nz") if name == "z" or "nx" in fields}
    return {axis: (fields | flat)[axis] for axis in AXES} | flat | fields


def _records(fields: dict[str, np.ndarray]) -> np.ndarray:
    rows = np.empty(len(fields["x"]), dtype=[(name, values.dtype) for name, values in fields.items()])
    for name, values in fields.items():
        rows[name] = values
    return rows


_Writer = Callable[[Path, dict[str, np.ndarray]], None]
WRITERS: dict[str, _Writer] = {
    ".ply": _write_ply,
    ".pcd": _write_pcd,
    ".npz": _write_npz,
    ".csv": _write_csv,
    ".xyz": _write_xyz,
}


def writer_of(path: str | Path) -> _Writer:
    """What writes files of this suffix; for asking before a long computation.

    Raises
    ------
    ValueError: no format is written by this suffix.
    """
    suffix = Path(path).suffix
    if suffix.lower() not in WRITERS:
        raise ValueError(f"{path} has the suffix {suffix!r}; writable are {' '.join(WRITERS)}")
    return WRITERS[suffix.lower()]
