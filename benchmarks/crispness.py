"""Which map is crisper, ours or the one at the true poses? Where a truth is itself an estimate, errors cannot tell.

    python -m benchmarks.crispness [--only kitti00 ...] [--again] [--out benchmarks/crispness.md]

Mean map entropy (``train/map_entropy.py``) of all points of the sequences in metres, at the true poses, at ours and at
those of small_gicp. Nothing here minimises it. Each of small_gicp's two kinds has the crispest of its settings and
starts, which flatters it.
"""

import argparse
from collections.abc import Callable
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np
import torch

from benchmarks.kept import keep, kept_results
from benchmarks.layer import cpu_name
from benchmarks.map_rivals import gicp
from benchmarks.mapping_rows import ROWS, Row
from benchmarks.mapping_table import map_errors
from train.config import EdgeConfig
from train.edges import register_edges
from train.map_entropy import mean_map_entropy
from train.scans import ScanSet

# Radius of a neighbourhood, metres, of the rows that begin so: some distances between neighbouring points of a scan.
# Not the kitchen and the bunny, where small_gicp takes many minutes.
RADII = {"balm": 0.5, "kitti": 1.0, "iclnuim": 0.05, "tum": 0.03, "dragon": 0.003}
TRUTH, OURS = "truth", "ours"
KINDS = {"small_gicp GICP": "GICP", "small_gicp point-to-plane": "PLANE_ICP"}


def radius_of(name: str) -> float | None:
    """Of a row's neighbourhoods; None for a row that is not asked."""
    return next((radius for begin, radius in RADII.items() if name.startswith(begin)), None)


def entropy(scans: ScanSet, poses: np.ndarray, radius: float) -> float:
    """Of all points, placed by ``poses (k, 4, 4)``."""
    placed = [scan @ pose[:3, :3].T + pose[:3, 3] for scan, pose in zip(scans.points, poses, strict=True)]
    return mean_map_entropy(np.concatenate(placed), radius)


def measured(name: str, row: Row, radius: float) -> dict[str, dict[str, float]]:
    """By whose poses: the entropy, and the row's own error in metres."""
    scans, told = row.make(), partial(_tell, name)
    assert scans.truth is not None
    ours = register_edges(scans, EdgeConfig(), told)[1].matrix.numpy()

    def judged(poses: np.ndarray) -> dict[str, float]:
        return {"entropy": entropy(scans, poses, radius), "error": map_errors(poses, scans, row)[row.error]}

    found = {TRUTH: judged(scans.truth), OURS: judged(ours)}
    for title, kind in KINDS.items():
        solutions = chain.from_iterable(gicp.solved(scans, kind, setting, told) for setting in gicp.SETTINGS)
        found[title] = min((judged(poses) for _, poses in solutions if np.isfinite(poses).all()), key=_entropy)
    return found


def _entropy(found: dict[str, float]) -> float:
    return found["entropy"]


def _tell(name: str, stage: str, done: int, total: int) -> None:
    print(f"\r{name} | {stage} {done}/{total}   ", end="", flush=True)


def line(name: str, found: dict[str, dict[str, float]]) -> str:
    """One row of the table; the least entropy bold."""
    least = min(map(_entropy, found.values()))
    mark: Callable[[float], str] = lambda value: f"**{value:.3f}**" if value == least else f"{value:.3f}"  # noqa: E731
    cells = [mark(found[TRUTH]["entropy"])]
    cells += [f"{mark(found[who]['entropy'])} ({found[who]['error']:.3g})" for who in (OURS, *KINDS)]
    return f"| {name} | {radius_of(name):g} | " + " | ".join(cells) + " |"


def table(results: dict[str, dict[str, dict[str, float]]]) -> str:
    """The whole table, rows in their order."""
    head = (
        f"Made by `python -m benchmarks.crispness` on {cpu_name()}: mean map entropy in nats (Razlaw et al., 2015) of\n"
        "all points, the lower the crisper; in brackets the row's error of `benchmarks/mapping_table.md`, metres.\n"
        "Each kind of small_gicp with the crispest of its three settings, with and without turned starts. Rows are\n"
        "kept from run to run: these are of several.\n"
    )
    titles = f"| sequence | radius, m | truth | ours | {' | '.join(KINDS)} |"
    rows = [line(name, results[name]) for name in ROWS if name in results]
    return "\n".join([head, titles, "|---" * (4 + len(KINDS)) + "|", *rows]) + "\n"


def main() -> None:
    """Measure the rows asked for and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], help="rows that begin with one of these")
    parser.add_argument("--again", action="store_true", help="measure rows again that are there")
    parser.add_argument("--out", type=Path, default=Path("benchmarks", "crispness.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = kept_results(options.out)
    for name, row in ROWS.items():
        radius = radius_of(name)
        if radius is None or not name.startswith(tuple(options.only)) or (name in results and not options.again):
            continue
        results[name] = measured(name, row, radius)
        print("\r" + line(name, results[name]), flush=True)
        keep(results, table(results), options.out)


if __name__ == "__main__":
    main()
