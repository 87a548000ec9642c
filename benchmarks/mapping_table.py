"""How far off are the maps of the registered edges, before any training, on every sequence at hand?

    python -m benchmarks.mapping_table [--only v1_pose0 balm ...] [--again] [--out benchmarks/mapping_table.md]

One configuration, the default, for everything; no starting poses, the truth is read for the errors alone. Rows that the
results file (``out/benchmark``, named as the table) already holds are not measured again unless ``--again`` is given.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.kept import keep, kept_results
from benchmarks.layer import cpu_name
from benchmarks.mapping_rows import ROWS, Row
from train.config import EdgeConfig
from train.edges import register_edges
from train.evaluate import evaluate_trajectory
from train.poses import embed_poses
from train.scans import ScanSet

MEASURES = ("ape_rmse", "point_rms_displacement")


def measured(row: Row) -> dict[str, float]:
    """Errors of the row's map in the row's unit, rotation in degrees, and seconds."""
    scans = row.make()
    begin = time.perf_counter(), time.process_time()
    edges, poses = register_edges(scans, EdgeConfig(), lambda *told: print("\r", *told, end="   ", flush=True))
    found = {"seconds": time.perf_counter() - begin[0], "CPU seconds": time.process_time() - begin[1]}
    return found | map_errors(poses.matrix.numpy(), scans, row) | {"scans": len(scans), "edges": len(edges.target)}


def map_errors(poses: np.ndarray, scans: ScanSet, row: Row) -> dict[str, float]:
    """Errors of poses ``(k, m, m)`` in the row's unit, rotation in degrees."""
    assert scans.truth is not None
    spatial = scans.points if scans.dimension == 3 else None
    errors = evaluate_trajectory(embed_poses(poses), embed_poses(scans.truth), spatial)
    found = {name: errors[name] * row.unit.scale for name in MEASURES if name in errors}
    return found | {"degrees": errors["rotation_error_mean_deg"]}


def line(name: str, found: dict[str, float]) -> str:
    """One row of the table."""
    row = ROWS[name]
    error, unit = found[row.error], row.unit.name
    verdict = "met" if error <= row.wanted else f"**{error / row.wanted:.3g} x**"
    points = f"{found['point_rms_displacement']:.3g}" if "point_rms_displacement" in found else ""
    cells = (name, f"{found['scans']:.0f}", f"{found['ape_rmse']:.3g}", points, unit, f"{found['degrees']:.2g}")
    rest = (
        f"{row.wanted:g}",
        verdict,
        f"{found['edges']:.0f}",
        f"{found['seconds']:.0f}",
        f"{found['CPU seconds']:.0f}",
    )
    return "| " + " | ".join(cells + rest) + " |"


def table(results: dict[str, dict[str, float]]) -> str:
    """The whole table, rows in their order."""
    head = (
        f"Made by `python -m benchmarks.mapping_table` on {cpu_name()}, one thread, the default configuration for\n"
        "every row; maps of the registered edges, before any training. ATE: RMSE of the positions after rigid\n"
        "alignment; points: RMS displacement of the scanned points; wanted: of the points for the last three rows,\n"
        "else of the positions.\n"
    )
    titles = "| sequence | scans | ATE | points | unit | rotation, deg | wanted | | edges | seconds | CPU seconds |"
    lines = [head, titles, "|---" * 11 + "|"] + [line(name, results[name]) for name in ROWS if name in results]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure the rows asked for and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], help="rows that begin with one of these")
    parser.add_argument("--again", action="store_true", help="measure rows again that are there")
    parser.add_argument("--out", type=Path, default=Path("benchmarks", "mapping_table.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = kept_results(options.out)
    chosen = [name for name in ROWS if name.startswith(tuple(options.only))]
    for name in chosen:
        if name in results and not options.again:
            continue
        results[name] = measured(ROWS[name])
        print("\r" + line(name, results[name]), flush=True)
        keep(results, table(results), options.out)


if __name__ == "__main__":
    main()
