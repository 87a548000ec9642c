"""How do time and memory of the mapper grow with the length of a log?

    python -m benchmarks.growth [--scans 115 229 458 915] [--again] [--out benchmarks/growth.md]

The first scans of the Intel Research Lab's log, with its odometry as starting poses, mapped as
``python -m train map --epochs 0`` does, files and pictures included, each length in a process of its own on one thread.
Peak memory is that of the process, Python and torch included. What ``out/benchmark/growth.json`` holds is not measured
again unless ``--again`` is given.
"""

import argparse
import resource
import sys
import time
from multiprocessing import get_context
from pathlib import Path

import torch

from benchmarks.data import data_folder
from benchmarks.kept import keep, kept_results
from train.config import MapConfig, TrainingConfig
from train.mapping import map_scans
from train.run_folder import open_run
from train.scans import ScanSet, read_scan_set

LOG, LENGTHS = "seq_radish2d_intel.npz", (115, 229, 458, 915)
WORK = Path("out", "benchmark", "growth")
# Bytes of one unit of ``ru_maxrss``: getrusage(2) counts kilobytes on Linux and bytes on macOS.
PEAK_UNIT = 1 if sys.platform == "darwin" else 1024
MB = 1e6


def beginning(scans: ScanSet, count: int) -> ScanSet:
    """The first ``count`` scans with their starting poses."""
    start = None if scans.start is None else scans.start[:count]
    return ScanSet(scans.points[:count], scans.names[:count], scans.timestamps[:count], start=start)


def measured(count: int) -> dict[str, float]:
    """Edges, CPU seconds, and the peak memory in bytes of this process before and after it mapped the first scans."""
    torch.set_num_threads(1)
    before = peak_memory()
    path = data_folder() / LOG
    begin = time.process_time()
    scans = beginning(read_scan_set([path], start=path), count)
    config = MapConfig(training=TrainingConfig(epochs=0))
    mapped = map_scans(open_run(WORK / str(count), scans, config, overwrite=True), scans, config, unit="m")
    assert mapped.result.edges is not None
    found = {"edges": len(mapped.result.edges.target), "CPU seconds": time.process_time() - begin}
    return found | {"before": before, "peak": peak_memory()}


def peak_memory() -> int:
    """Bytes that this process has held at most so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * PEAK_UNIT


def table(results: dict[str, dict[str, float]]) -> str:
    """The whole text, the shortest beginning first."""
    lines = [
        "Made by `python -m benchmarks.growth`, one thread: the first scans of the Intel Research Lab's log with its",
        "odometry, mapped as `python -m train map --epochs 0` does, files and pictures included, each length in a",
        "process of its own. Peak memory: of the process, and what it was when all was imported and nothing read.",
        "",
        "| scans | edges | CPU seconds | CPU seconds per edge | peak memory, MB | before |",
        "|---|---|---|---|---|---|",
    ]
    for count in sorted(results, key=int):
        edges, seconds = results[count]["edges"], results[count]["CPU seconds"]
        peak, before = (round(results[count][name] / MB) for name in ("peak", "before"))
        lines.append(f"| {count} | {edges} | {seconds:.0f} | {seconds / edges:.3f} | {peak} | {before} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure the lengths asked for and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", nargs="+", type=int, default=list(LENGTHS))
    parser.add_argument("--again", action="store_true", help="measure lengths again that are there")
    parser.add_argument("--out", type=Path, default=Path("benchmarks", "growth.md"))
    options = parser.parse_args()
    results = kept_results(options.out)
    for count in options.scans:
        if options.again or str(count) not in results:
            # A new interpreter for each: a fork would begin with the memory of this one.
            with get_context("spawn").Pool(1) as own_process:
                results[str(count)] = own_process.apply(measured, (count,))
            print(count, results[str(count)], flush=True)
            keep(results, table(results), options.out)


if __name__ == "__main__":
    main()
