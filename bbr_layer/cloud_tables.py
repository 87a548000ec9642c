"""Readers of plain tables of numbers: KITTI .bin, .npy, .npz, and text (.xyz .txt .csv)."""

from itertools import islice
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bbr_layer.cloud_columns import Columns, are_unit, chosen_names, columns_by_count, columns_by_name, real_numbers

BIN_BYTES = 4  # float32, the KITTI velodyne layout
RINGS = 256  # more than the lasers of any lidar; the number of the laser is the fifth column of nuScenes
POINT_KEYS = ("points", "P", "xyz")  # what an .npz calls its points, the first one found
COMMENTS = ("#", "//")  # before the first row; after it only "#"


def read_bin(path: Path) -> Columns:
    """Float32 rows: x y z reflectance (KITTI), x y z nx ny nz where the last three have unit length, or x y z intensity
    ring (nuScenes) where the fifth column holds small whole numbers and the first three do not.

    Raises
    ------
    ValueError: the size is that of none, as of a file cut short.
    """
    values = np.fromfile(path, dtype="<f4")
    size = path.stat().st_size
    if size % (6 * BIN_BYTES) == 0 and size and are_unit(values.reshape(-1, 6)[:, 3:]):
        return columns_by_count(values.reshape(-1, 6))
    if size % (5 * BIN_BYTES) == 0 and size and _have_rings(values.reshape(-1, 5)):
        return columns_by_count(values.reshape(-1, 5))
    if size % (4 * BIN_BYTES) == 0:
        return columns_by_count(values.reshape(-1, 4))
    raise ValueError(
        f"its {size} bytes are no whole rows of 4 float32 (x y z reflectance), nor of 5 with the number of a laser, "
        "nor of 6 with unit normals"
    )


def _have_rings(table: Float[np.ndarray, "n 5"]) -> bool:
    """Does the fifth column number the lasers? In rows of another length it would hold coordinates, too."""
    rings = table[:, 4]
    whole = table == np.floor(table)
    return bool(whole[:, 4].all() and (rings >= 0).all() and (rings < RINGS).all() and not whole[:, :3].all())


def read_npy(path: Path) -> Columns:
    """One array of rows, see ``columns_by_count``."""
    return columns_by_count(real_numbers(np.load(path, allow_pickle=False)))


def read_npz(path: Path) -> Columns:
    """Arrays ``points`` (or ``P``, ``xyz``) and, optionally, ``normals`` and ``intensity``.

    Raises
    ------
    ValueError: none of the keys is there, or the file holds several scans (``offsets``).
    """
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        key = next((key for key in POINT_KEYS if key in arrays.files), None)
        if key is None:
            raise ValueError(f"it holds {', '.join(arrays.files)}; an array named points, P or xyz is wanted")
        if "offsets" in arrays.files:
            count = max(arrays["offsets"].size - 1, 0)
            raise ValueError(f"it holds {count} scans, not one; read_scans reads them")
        columns = columns_by_count(real_numbers(arrays[key]))
        given = {name: real_numbers(arrays[name]) for name in ("normals", "intensity") if name in arrays.files}
    shapes = {"normals": columns.points.shape, "intensity": columns.points.shape[:1]}
    for name, values in given.items():
        if values.shape != shapes[name]:
            raise ValueError(f"its {name} have shape {values.shape} and its points {columns.points.shape}")
    return columns._replace(**given)


def read_npz_sequence(path: Path) -> list[Columns]:
    """Several scans: ``points (n, 2 or 3)`` cut at ``offsets``, which rise from 0 to n.

    Raises
    ------
    ValueError: the arrays are not those.
    """
    with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        if missing := {"points", "offsets"} - set(arrays.files):
            raise ValueError(f"it holds {', '.join(arrays.files)} and lacks {' and '.join(sorted(missing))}")
        points, offsets = arrays["points"], arrays["offsets"]
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"its points have shape {points.shape}; rows of x y or x y z are wanted")
    if offsets.ndim != 1 or len(offsets) < 2 or not np.issubdtype(offsets.dtype, np.integer):
        raise ValueError(f"its offsets are {offsets.dtype} of shape {offsets.shape}; a row of integers is wanted")
    if offsets[0] != 0 or offsets[-1] != len(points) or (offsets[1:] < offsets[:-1]).any():
        raise ValueError(f"its offsets do not rise from 0 to the number of points, {len(points)}")
    pairs = zip(offsets[:-1], offsets[1:], strict=True)
    return [Columns(real_numbers(points[begin:end])) for begin, end in pairs]


def read_text(path: Path) -> Columns:
    """Rows of numbers divided by blanks, commas, semicolons or tabs, under a header of names if there is one.

    Before the first row, lines beginning with ``#`` or ``//`` are comments (one that names x and y is a
    header), and a single number is the count of points, as in .pts files. Columns that the header does not
    name as coordinates, normals or intensity may hold anything.

    Raises
    ------
    ValueError: a line that is neither a header nor numbers.
    """
    header, skipped = _preamble(path)
    if header is not None and not _names_points(header):
        raise ValueError(f"its line {header[:60]!r} is neither numbers nor a header with x and y")
    with path.open(encoding="utf-8-sig") as file:
        first = next(islice(file, skipped, None), None)
    if first is None:
        return Columns(np.empty((0, 3)))
    if header is None:
        return columns_by_count(_rows(path, first, skipped))
    names = _split(header)
    wanted = list(chosen_names(names).values())
    table = _rows(path, first, skipped, [names.index(name) for name in wanted])
    return columns_by_name(dict(zip(wanted, table.T, strict=True)))


def _preamble(path: Path) -> tuple[str | None, int]:
    """The header line, if there is one, and how many lines stand before the first row."""
    header, seen = None, 0
    with path.open(encoding="utf-8-sig") as file:
        for line in file:
            fields = _split(line)
            is_comment = line.lstrip().startswith(COMMENTS)
            if is_comment and _names_points(line):
                header = line
            elif not is_comment and fields and not _is_number(fields[0]):
                if header is not None:
                    return header, seen
                header = line
            elif not is_comment and len(fields) > 1:
                return header, seen
            seen += 1
    return header, seen


def _split(line: str) -> list[str]:
    return line.strip(" \t\n#/").split(_delimiter(line))


def _delimiter(line: str) -> str | None:
    return next((sign for sign in ",;\t" if sign in line), None)


def _names_points(line: str) -> bool:
    return {"x", "y"} <= chosen_names(_split(line)).keys()


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _rows(path: Path, first: str, skipped: int, columns: list[int] | None = None) -> np.ndarray:
    return np.loadtxt(
        path, delimiter=_delimiter(first), skiprows=skipped, usecols=columns, ndmin=2, encoding="utf-8-sig"
    )
