"""How many points soft buddies should be sought among: failures and seconds of the default layer with several.

    python -m benchmarks.soft_points --repeats 20 --out benchmarks/soft_points.md

The trials are those of ``benchmarks.paper``, disjoint sampling, with seeds from 1000 on, and those streets and rooms of
``benchmarks.reliability_trials`` that have a thousand points, with draws that no confidence is fitted to.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from bbr_layer import BBRLayer, Detached, atomic_write
from bbr_layer.named_stages import default_stages
from benchmarks.paper_experiments import EXPERIMENTS
from benchmarks.paper_methods import by_layer
from benchmarks.paper_results import FAILED_DEG
from benchmarks.paper_trials import Trial
from benchmarks.reliability_trials import clouds, trials

SOFT_POINTS = (200, 300, 400, 500, 700, 1000)
FIRST_SEED = 1000
# Draws of streets and rooms: those before are what the confidence is fitted to.
FIRST_DRAW, DRAWS, SCAN_POINTS, WIDEST_DEG = 4, 12, 1000, 90.0


class Group(NamedTuple):
    """Trials of one column: of which experiment, and which of its cells."""

    name: str
    experiment: str
    least_x: float


GROUPS = (
    Group("models, 500 points, 60 and 90 deg", "fig2", 60.0),
    Group("horse, distractor of 900", "fig5", 900.0),
    Group("bun180/270, 1000 points", "fig7", 0.0),
    Group("streets and rooms, 1000 points, 5 to 90 deg", "scans", 0.0),
)


def trials_of(group: Group, repeats: int) -> Iterator[Trial]:
    """All registrations of a column."""
    if group.experiment == "scans":
        yield from _scans()
        return
    experiment = next(x for x in EXPERIMENTS if x.name == group.experiment)
    for cell in experiment.cells("disjoint"):
        if cell.x >= group.least_x:
            yield from (cell.make(FIRST_SEED + number) for number in range(repeats))


def _scans() -> Iterator[Trial]:
    for trial in trials(DRAWS):
        new = trial.seed >= FIRST_DRAW and trial.points == SCAN_POINTS and trial.degrees <= WIDEST_DEG
        if new and trial.group in ("lidar", "indoor"):
            drawn = clouds(trial)
            yield Trial(drawn.P, drawn.Q, drawn.truth, drawn.P_normals, drawn.Q_normals)


def row(points: int, repeats: int) -> str:
    """Failures of every column and the processor seconds of one registration."""
    cells = []
    for group in GROUPS:
        layer = BBRLayer(*default_stages(points), backward=Detached())
        _one(layer, next(trials_of(group, 1)))  # what is compiled once does not count
        degrees, seconds = np.array([_one(layer, trial) for trial in trials_of(group, repeats)]).T
        cells.append(f"{int((degrees > FAILED_DEG).sum())}/{len(degrees)}, {seconds.mean():.3f} s")
    return f"| {points} | " + " | ".join(cells) + " |"


def _one(layer: BBRLayer, trial: Trial) -> tuple[float, float]:
    before = time.process_time()
    found = by_layer(layer, trial)
    seconds = time.process_time() - before
    return trial.errors(found)[0], seconds


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="the points of soft buddies")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/soft_points.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        f"Made by `python -m benchmarks.soft_points --repeats {options.repeats}` on one thread: failures over 5 "
        "degrees and mean processor seconds of `BBRLayer()`, softBBS, its first stage, seeing so many points at most. "
        "The clouds share no point; normals are their own, those of half of the streets and rooms the whole scans'.",
        "",
        "| soft points | " + " | ".join(group.name for group in GROUPS) + " |",
        "|---" * (len(GROUPS) + 1) + "|",
    ]
    for points in SOFT_POINTS:
        lines.append(row(points, options.repeats))
        print(lines[-1], flush=True)
    with atomic_write(options.out) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
