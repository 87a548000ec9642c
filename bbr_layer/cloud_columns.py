"""Columns of numbers turned into points, normals and intensity: by their names, or by their number."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# How the field calls its columns, lower case: PLY and PCD headers, CloudCompare, ParaView, PDAL.
SYNONYMS = {
    "x": ("x", "points:0", "points_0"),
    "y": ("y", "points:1", "points_1"),
    "z": ("z", "points:2", "points_2"),
    "nx": ("nx", "normal_x", "normalx", "normals:0", "normals_0"),
    "ny": ("ny", "normal_y", "normaly", "normals:1", "normals_1"),
    "nz": ("nz", "normal_z", "normalz", "normals:2", "normals_2"),
    "intensity": ("intensity", "scalar_intensity", "reflectance", "reflectivity", "remission", "i"),
}

# Three columns are normals when their length is 1 within this, the rounding of three decimals; a wider
# tolerance would take coordinates of small objects for normals.
UNIT_TOLERANCE = 2e-3
# Missing normals are written as zeros: up to this share of the rows may have none.
MISSING_NORMALS = 0.5


class Columns(NamedTuple):
    """What a file holds, before anything is dropped."""

    points: Float[np.ndarray, "n d"]
    normals: Float[np.ndarray, "n d"] | None = None
    intensity: Float[np.ndarray, "n"] | None = None


def plain_name(name: str) -> str:
    """A column's name without quotes, comment signs, units and capitals: ``'//X [m]'`` is ``'x'``."""
    return name.strip(" \t\"'#/").lower().split("[")[0].split("(")[0].strip()


def chosen_names(names: Iterable[str]) -> dict[str, str]:
    """Which of the given column names hold ``x y z nx ny nz intensity``; those not found are absent."""
    by_plain = {plain_name(name): name for name in names}
    return {
        role: by_plain[next(known for known in synonyms if known in by_plain)]
        for role, synonyms in SYNONYMS.items()
        if any(known in by_plain for known in synonyms)
    }


def columns_by_name(fields: Mapping[str, np.ndarray]) -> Columns:
    """Points, normals and intensity from named columns ``(n,)``; without a z column the cloud is 2D.

    Raises
    ------
    ValueError: there is no x or no y.
    """
    chosen = chosen_names(fields)
    if "x" not in chosen or "y" not in chosen:
        raise ValueError(f"it has the columns {', '.join(fields) or 'none'}; x and y (and z) are wanted")
    axes = [axis for axis in "xyz" if axis in chosen]
    normal_axes = [f"n{axis}" for axis in axes]
    normals = None
    if all(axis in chosen for axis in normal_axes):
        normals = _stacked([fields[chosen[axis]] for axis in normal_axes])
    intensity = np.asarray(fields[chosen["intensity"]], dtype=np.float64) if "intensity" in chosen else None
    return Columns(_stacked([fields[chosen[axis]] for axis in axes]), normals, intensity)


def columns_by_count(table: Float[np.ndarray, "n c"]) -> Columns:
    """Points, normals and intensity from a table without names.

    2 columns are x y; 3 are x y z; 4 or 5 are x y z intensity (and what follows); from 6 on, columns 4 to 6
    are normals if they have unit length, and ignored (colours, labels) if not.

    Raises
    ------
    ValueError: fewer than two columns.
    """
    if table.ndim != 2 or table.shape[1] < 2:
        raise ValueError(f"it holds numbers of shape {table.shape}; rows of x y or x y z are wanted")
    table = table.astype(np.float64)
    points, count = table[:, :3], table.shape[1]
    if count >= 6 and are_unit(table[:, 3:6]):
        return Columns(points, normals=table[:, 3:6])
    return Columns(points, intensity=table[:, 3] if count in (4, 5) else None)


def real_numbers(values: np.ndarray) -> np.ndarray:
    """The array as float64.

    Raises
    ------
    ValueError: it holds complex numbers or no numbers.
    """
    if np.iscomplexobj(values):
        raise ValueError(f"it holds {values.dtype} numbers; coordinates are real")
    return values.astype(np.float64)


def are_unit(vectors: Float[np.ndarray, "n 3"]) -> bool:
    """Do these rows look like normals: of length 1, except for missing ones (zeros, NaN)?"""
    length = lengths(vectors)
    present = np.isfinite(length) & (length > 0)
    return present.mean() > MISSING_NORMALS and bool((np.abs(length[present] - 1) < UNIT_TOLERANCE).all())


def lengths(vectors: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n"]:
    """Euclidean length of each row; infinite, without a warning, where a damaged file holds 1e300."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.linalg.norm(vectors.astype(np.float64), axis=1)


def _stacked(columns: list[np.ndarray]) -> Float[np.ndarray, "n d"]:
    with np.errstate(invalid="ignore"):  # a NaN of any kind stays NaN, and its point is dropped later
        return np.stack([np.asarray(column, dtype=np.float64) for column in columns], axis=1)
