"""What does the density of the points do to the error of maps of KITTI?

    python -m benchmarks.voxels [--only "kitti00 0-15, stride 4" ...] [--again] [--out benchmarks/voxels.md]

small_gicp's GICP and point-to-plane ICP, each scan with the one before, at several voxels; and our maps, refined at
several numbers of points. Every pair of small_gicp **begins at our poses**, those of the default configuration, and has
a gate of 1 m, so that only what the density does is seen and not whether a pair is found. Beside the error against the
truth stands the distance to our map of the default configuration. Ours are registered once for each row and density
and kept in ``out/benchmark/voxels.json``, as everything else that was measured.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.kept import keep, kept_results
from benchmarks.map_rivals.chain import along, in_own_unit, reach
from benchmarks.map_rivals.gicp import Setting, SmallGicp
from benchmarks.mapping_rows import ROWS
from benchmarks.mapping_table import map_errors
from train.config import EdgeConfig
from train.edges import register_edges
from train.scans import ScanSet

CHOSEN = ("kitti00 0-15, stride 1", "kitti00 0-15, stride 2", "kitti00 0-15, stride 4", "kitti07 submaps, stride 1")
KINDS, OURS = {"GICP": "GICP", "PLANE_ICP": "point-to-plane"}, "ours"
# Side of a voxel, in metres, and most points of a scan in our refinement.
VOXELS, POINTS = (0.1, 0.2, 0.3, 0.5, 1.0), (2500, 5000, 10000, 20000)
DEFAULT = str(EdgeConfig().refined_points)
# Farthest match, in metres; the rest of small_gicp's settings is that of the rivals' bench.
GATE = 1.0
# By row and way: points of a scan, error and distance in metres, and of ours the poses.
Results = dict[str, dict[str, dict[str, Any]]]


def ours(scans: ScanSet, most: int) -> tuple[float, np.ndarray]:
    """Points of a scan (median) and poses of our map, refined at most at ``most`` points."""
    config = EdgeConfig(refined_points=most)
    _, poses = register_edges(scans, config, lambda *told: print("\r", *told, end="   ", flush=True))
    return float(np.median([min(most, len(points)) for points in scans.points])), poses.matrix.numpy()


def chained(scans: ScanSet, kind: str, voxel: float, begin: np.ndarray) -> tuple[float, np.ndarray]:
    """Points of a scan (median) and poses ``(k, 4, 4)`` along small_gicp's pairs, each begun at the poses given."""
    unit = reach(scans)
    rival = SmallGicp(scans, kind, Setting(voxel / unit, (GATE / unit,), follow=False))
    begin = in_own_unit(begin, 1 / unit)
    motions = [rival.register(i, i + 1, np.linalg.inv(begin[i]) @ begin[i + 1]) for i in range(len(scans) - 1)]
    return float(np.median([cloud.size() for cloud in rival.clouds])), in_own_unit(along(np.stack(motions)), unit)


def measure(name: str, found: dict[str, dict[str, Any]], kept: Callable[[], None]) -> None:
    """Fill in what is lacking of a row; ``kept`` is called after each."""
    row = ROWS[name]
    scans = row.make()

    def numbers(points: float, poses: np.ndarray, default: np.ndarray) -> dict[str, Any]:
        error, apart = (map_errors(poses, held, row)[row.error] for held in (scans, replace(scans, truth=default)))
        return {"points": points, "error": error, "apart": apart}

    for most in sorted(POINTS, key=lambda most: str(most) != DEFAULT):  # the default first: the others are held to it
        way = f"{OURS} {most}"
        if way not in found:
            points, poses = ours(scans, most)
            default = np.array(found[f"{OURS} {DEFAULT}"]["poses"]) if str(most) != DEFAULT else poses
            found[way] = numbers(points, poses, default) | {"poses": poses.tolist()}
            kept()
    default = np.array(found[f"{OURS} {DEFAULT}"]["poses"])
    for kind, voxel in product(KINDS, VOXELS):
        way = f"{kind} {voxel}"
        if way not in found:
            found[way] = numbers(*chained(scans, kind, voxel, default), default)
            print(f"\r{name}, {way}: {found[way]['error']:.4f} m", flush=True)
            kept()


def line(name: str, way: str, one: dict[str, Any]) -> str:
    """One row of the table."""
    kind, density = way.split()
    if kind == OURS:
        setting = f"at most {density} points" + " (default)" * (density == DEFAULT)
    else:
        setting = f"voxel {density} m"
    cells = (name, KINDS.get(kind, kind), setting, f"{one['points']:.0f}", f"{one['error']:.4f}", f"{one['apart']:.4f}")
    return "| " + " | ".join(cells) + " |"


def table(results: Results) -> str:
    """The whole text, the densest setting of each method first."""
    head = (
        "Made by `python -m benchmarks.voxels`, one thread. GICP and point-to-plane: small_gicp, each scan with the\n"
        f"one before, **begun at our poses**, gate {GATE:g} m. Points: of a scan, median.\n"
        "Error: RMSE of the positions after rigid alignment, against the truth (of kitti00 a chain of point-to-plane\n"
        "ICP, of kitti07 the estimate of a SLAM); from ours: the same against our map of the default configuration.\n"
        "Metres.\n"
    )
    titles = "| sequence | method | setting | points | error | from ours |"
    ways = [f"{kind} {voxel}" for kind, voxel in product(KINDS, VOXELS)]
    ways += [f"{OURS} {most}" for most in reversed(POINTS)]
    lines = [head, titles, "|---" * 6 + "|"]
    for name in CHOSEN:
        found = results.get(name, {})
        lines += [line(name, way, found[way]) for way in ways if way in found]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure the rows asked for and write the table after each measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], help="rows that begin with one of these")
    parser.add_argument("--again", action="store_true", help="measure rows again that are there")
    parser.add_argument("--out", type=Path, default=Path("benchmarks", "voxels.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: Results = kept_results(options.out)
    for name in CHOSEN:
        if name.startswith(tuple(options.only)):
            found = {} if options.again else results.get(name, {})
            results[name] = found
            measure(name, found, lambda: keep(results, table(results), options.out))
            keep(results, table(results), options.out)


if __name__ == "__main__":
    main()
