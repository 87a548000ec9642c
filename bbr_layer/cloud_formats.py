"""Readers of point-cloud and mesh formats: PLY, PCD, LAS and LAZ, and the meshes trimesh knows."""

import io
import re
import warnings
from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO

import numpy as np
import plyfile

from bbr_layer.cloud_columns import Columns, columns_by_name

PLY_KEYWORDS = (b"ply", b"format", b"comment", b"obj_info", b"element", b"property", b"end_header")
PLY_HEADER_LINES = 10_000  # no header is longer; a file without "end_header" is given up after so many lines
PCD_HEADER_LINES = 1_000
# What a .pcd of an early version may leave out, and the version its header is then read as.
PCD_DEFAULTS = {"VERSION": "0.7", "HEIGHT": "1", "VIEWPOINT": "0 0 0 1 0 0 0"}
CUT_SHORT = "its header promises {} points and {} are there: the file is cut short"
LAS_EXTRA = 'pip install "laspy[lazrs]"'


def read_ply(path: Path) -> Columns:
    """Vertices of a PLY file, ascii or binary, with ``nx ny nz`` and an intensity where it has them.

    Header lines that are no PLY (the ``bye`` of old Cyberware scans) are skipped, and elements after the
    vertices (faces, range grids) are not read.

    Raises
    ------
    ValueError, plyfile.PlyParseError: no PLY, no vertices, or fewer of them than the header says.
    """
    with path.open("rb") as file:
        header = _ply_header(file)
        offset = file.tell()
        layout = plyfile.PlyData.read(io.BytesIO(re.sub(rb"(element \S+) +\d+", rb"\1 0", header)))
        counts = {name.decode(): int(count) for name, count in re.findall(rb"element (\S+) +(\d+)", header)}
        if "vertex" not in counts:
            raise ValueError(f"it has the elements {', '.join(counts) or 'none'}; one named vertex is wanted")
        vertex, count = layout["vertex"], counts["vertex"]
        has_lists = any(isinstance(prop, plyfile.PlyListProperty) for prop in vertex.properties)
        if layout.elements[0].name != "vertex" or has_lists:
            rows = plyfile.PlyData.read(io.BytesIO(header + file.read()))["vertex"].data
        elif layout.text:
            rows = _text_rows(file, vertex.dtype(), count)
        else:
            rows = np.fromfile(path, dtype=vertex.dtype(layout.byte_order), count=count, offset=offset)
    if len(rows) != count:
        raise ValueError(CUT_SHORT.format(count, len(rows)))
    return columns_by_name(_fields(rows))


def _ply_header(file: BinaryIO) -> bytes:
    """The header in lines that the PLY library knows, leaving ``file`` at the first byte after it."""
    lines = []
    for _ in range(PLY_HEADER_LINES):
        line = file.readline(PLY_HEADER_LINES)
        if line.startswith(PLY_KEYWORDS):
            lines.append(line.strip() + b"\n")
        if line.startswith(b"end_header") or not line:
            break
    if not lines or lines[0] != b"ply\n" or lines[-1] != b"end_header\n":
        raise ValueError("it does not begin with a PLY header, from 'ply' to 'end_header'")
    return b"".join(lines)


def read_pcd(path: Path) -> Columns:
    """Points of a PCD file (ascii, binary, binary_compressed; versions .5 to .7), with normals and intensity.

    Raises
    ------
    ValueError, RuntimeError, struct.error: no PCD, or fewer points than the header says.
    """
    from pypcd4.pypcd4 import Encoding, MetaData, PointCloud

    with path.open("rb") as file:
        header = _pcd_header(file)
        metadata = MetaData.parse_header(header)
        if metadata.data is Encoding.ASCII:
            # The library divides ascii rows at each single blank; files with two in a row are common.
            rows = _text_rows(file, metadata.build_dtype(), metadata.points)
        else:
            repaired = "".join(f"{line}\n" for line in header).encode() + file.read()
            rows = PointCloud.from_fileobj(io.BufferedReader(io.BytesIO(repaired))).pc_data
    if len(rows) != metadata.points:
        raise ValueError(CUT_SHORT.format(metadata.points, len(rows)))
    return columns_by_name(_fields(rows))


def _pcd_header(file: BinaryIO) -> list[str]:
    """Header lines of version 0.7, made up where older versions lack them, with ``DATA`` last."""
    entries: dict[str, str] = {}
    for _ in range(PCD_HEADER_LINES):
        line = file.readline(PCD_HEADER_LINES).decode("latin1").strip()
        key, _, value = line.partition(" ")
        if line and not line.startswith("#"):
            entries[key.upper()] = value
        if key.upper() == "DATA":
            break
    missing = [key for key in ("FIELDS", "SIZE", "TYPE", "WIDTH", "DATA") if key not in entries]
    if missing:
        raise ValueError(f"its PCD header lacks {', '.join(missing)}")
    points = int(entries["WIDTH"]) * int(entries.get("HEIGHT", PCD_DEFAULTS["HEIGHT"]))
    ones = " ".join("1" for _ in entries["FIELDS"].split())
    entries = PCD_DEFAULTS | {"COUNT": ones, "POINTS": str(points)} | entries
    entries["VERSION"] = PCD_DEFAULTS["VERSION"]
    data = entries.pop("DATA")
    return [*(f"{key} {value}" for key, value in entries.items()), f"DATA {data}"]


def _fields(rows: np.ndarray) -> dict[str, np.ndarray]:
    return {name: rows[name] for name in rows.dtype.names or ()}


def _text_rows(file: BinaryIO, dtype: np.dtype, count: int) -> np.ndarray:
    """Up to ``count`` rows of numbers, as many as there are."""
    if count == 0:
        return np.empty(0, dtype)
    with warnings.catch_warnings():  # numpy warns of blank and missing lines; the callers count the rows
        warnings.simplefilter("ignore", UserWarning)
        return np.loadtxt(file, dtype=dtype, max_rows=count, encoding="latin1", ndmin=1)


def read_las(path: Path) -> Columns:
    """Points of a LAS or LAZ file in its own coordinates (scaled and offset), with intensity.

    Raises
    ------
    ValueError: the library laspy (for .laz with lazrs) is missing, or the file is none.
    """
    if find_spec("laspy") is None:
        raise ValueError(f"LAS and LAZ are read by the library laspy, which is not installed: {LAS_EXTRA}")
    import laspy

    try:
        cloud = laspy.read(path)
    except laspy.errors.LaspyException as error:
        raise ValueError(f"laspy says: {error}; for .laz: {LAS_EXTRA}") from error
    if len(cloud.points) != cloud.header.point_count:
        raise ValueError(CUT_SHORT.format(cloud.header.point_count, len(cloud.points)))
    return Columns(np.asarray(cloud.xyz), intensity=np.asarray(cloud.intensity, dtype=np.float64))


def read_mesh(path: Path) -> Columns:
    """Vertices of a mesh (.obj .stl .off), each once, though such files repeat them per face."""
    import trimesh

    scene = trimesh.load_scene(path, process=False)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh | trimesh.PointCloud)]
    if not parts:
        return Columns(np.empty((0, 3)))
    stacked = np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in parts])
    _, first = np.unique(stacked, axis=0, return_index=True)
    return Columns(stacked[np.sort(first)])
