"""Real scans mapped from folders as the command line does it, and the registration terms side by side.

    python -m benchmarks.mapping sequences [--only balm ...] [--again] [--out benchmarks/mapping_sequences.md]
    python -m benchmarks.mapping terms [--only F ...] [--seeds 3] [--network 0] [--again] [--out ...]

``sequences`` writes DeepMapping's v1_pose0 (PCD), KITTI 00 and BALM (PLY) as folders of scans beside a file of their
true poses, maps each folder as ``python -m train map`` does, and reports the error of the edges' map and of the
trained one; the truth is read for that alone. Scans, maps and pictures stay in ``out/benchmark``. ``terms``: see
``benchmarks/mapping_starts.py``. What ``out/benchmark`` holds is not measured again unless ``--again`` is given.
"""

import argparse
import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from bbr_layer import RigidMotion, write_cloud, write_poses_tum
from benchmarks.data import data_folder
from benchmarks.kept import keep, kept_results
from benchmarks.mapping_starts import ape, measured_terms, terms_table
from train.config import TERMS, MapConfig
from train.console import PrintedUnit
from train.mapping import map_scans
from train.run_folder import open_run
from train.scans import read_scan_set


class Sequence(NamedTuple):
    """A file of scans, the format they are written in, and the unit of the errors in the table."""

    file: str
    suffix: str
    unit: PrintedUnit


SEQUENCES = {
    "v1_pose0, every scan": Sequence("seq_deepmapping2d_v1_pose0", ".pcd", PrintedUnit(512.0, "px")),
    "kitti00 0-15": Sequence("seq_kitti00_0-15", ".ply", PrintedUnit(1.0, "m")),
    "balm 30-108": Sequence("seq_balm_realworld_30-108", ".ply", PrintedUnit(1.0, "m")),
}
WORK = Path("out", "benchmark")
Results = dict[str, dict[str, Any]]


def as_folder(chosen: Sequence, work: Path) -> tuple[Path, Path]:
    """Scans written as files of a folder, each in its sensor's frame, and their true poses as a file beside it."""
    held = np.load(data_folder() / f"{chosen.file}.npz", allow_pickle=False)
    scans, truth = work / "scans", work / "truth_tum.txt"
    scans.mkdir(parents=True, exist_ok=True)
    bounds, poses = held["offsets"], held["poses"].astype(float)
    for number in range(len(poses)):
        points = held["points"][bounds[number] : bounds[number + 1]]
        write_cloud(scans / f"{number:04d}{chosen.suffix}", points)
    write_poses_tum(truth, np.linalg.inv(poses[0]) @ poses, np.arange(len(poses), dtype=float))
    return scans, truth


def mapped(name: str) -> dict[str, Any]:
    """Errors of both maps of a sequence in its data's unit, the epoch that was kept, and seconds."""
    chosen, config = SEQUENCES[name], MapConfig()
    work = WORK / chosen.file
    folder, truth = as_folder(chosen, work)
    begin = time.perf_counter(), time.process_time()
    scans = read_scan_set([folder], truth=truth)
    run = open_run(work / "map", scans, config, overwrite=True)
    found = map_scans(run, scans, config, unit=chosen.unit.of_files)
    trained = RigidMotion.from_matrix(torch.from_numpy(found.result.world_from_scan))
    return {
        "scans": len(scans),
        "errors": [ape(poses, scans) for poses in (found.start, trained)],
        "kept": found.kept_epoch,
        "seconds": time.perf_counter() - begin[0],
        "CPU seconds": time.process_time() - begin[1],
    }


def sequences_table(results: Results) -> str:
    """The table of what was measured so far."""
    lines = [
        "Made by `python -m benchmarks.mapping sequences`, one thread, the default configuration.",
        "",
        "| sequence | scans | edges' map | trained | kept epoch | seconds | CPU seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in (name for name in SEQUENCES if name in results):
        one = results[name]
        errors = " | ".join(SEQUENCES[name].unit.length(error) for error in one["errors"])
        took = f"{one['seconds']:.0f} | {one['CPU seconds']:.0f}"
        lines.append(f"| {name} | {one['scans']} | {errors} | {one['kept']} | {took} |")
    return "\n".join(lines) + "\n"


def measured_sequences(names: list[str], results: Results) -> Iterator[tuple[str, dict[str, Any]]]:
    """Sequences that begin with one of the names and that the results lack, each when it is measured."""
    for name in SEQUENCES:
        if name.startswith(tuple(names)) and name not in results:
            yield name, mapped(name)


def main() -> None:
    """Measure what is missing of the table asked for and write it after each measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=["sequences", "terms"])
    parser.add_argument("--only", nargs="+", help="sequences that begin with one of these; these terms")
    parser.add_argument("--seeds", type=int, default=3, help="of a free correction per scan")
    parser.add_argument("--network", type=int, default=0, help="seeds of L-Net, some ten minutes each")
    parser.add_argument("--again", action="store_true", help="measure again what is there")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    out = options.out or Path("benchmarks", f"mapping_{options.table}.md")
    results: Results = kept_results(out)
    there: Results = {} if options.again else results
    table: Callable[[Results], str]
    if options.table == "sequences":
        rows, table = measured_sequences(options.only or [""], there), sequences_table
    else:
        seeds = {"direct": options.seeds, "network": options.network}
        rows, table = measured_terms(options.only or list(TERMS), seeds, there), terms_table
    for name, found in rows:
        results[name] = found
        print(name, found, flush=True)
        keep(results, table(results), out)
    if results:
        keep(results, table(results), out)


if __name__ == "__main__":
    main()
