"""What it brings to begin again about the best answer: the errors of ``BBRLayer.robust()`` by how far about it.

    python -m benchmarks.around --repeats 20 --out benchmarks/around.md

The trials are those of ``benchmarks.paper``, disjoint sampling, with seeds from 1000 on.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np
import torch

from bbr_layer import BBRLayer, Detached, atomic_write, starts
from benchmarks.paper_experiments import EXPERIMENTS, Cell
from benchmarks.paper_methods import by_layer
from benchmarks.paper_results import spread

TURNS_DEG = (0.0, 4.0, 8.0, 12.0, 16.0)
CHOSEN = ("fig4", "fig5", "fig7")
FIRST_SEED = 1000


def row(cell: Cell, repeats: int) -> str:
    """Median and 90th percentile of the angle for every turn, failures, and seconds at the turn that is the layer's."""
    layer, own = BBRLayer.robust(Detached()), starts.AROUND
    degrees, seconds = np.zeros((repeats, len(TURNS_DEG))), 0.0
    for number in range(repeats):
        trial = cell.make(FIRST_SEED + number)
        for column, turn in enumerate(TURNS_DEG):
            starts.AROUND = math.radians(turn)
            before = time.process_time()
            found = by_layer(layer, trial)
            seconds += (time.process_time() - before) * (starts.AROUND == own)
            degrees[number, column] = trial.errors(found)[0]
    starts.AROUND = own
    return f"| {cell.name} | " + " | ".join(map(spread, degrees.T)) + f" | {seconds / repeats:.2f} |"


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="starts about the best answer")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/around.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        f"Made by `python -m benchmarks.around --repeats {options.repeats}` on one thread: median / 90th percentile of "
        "the angle of `BBRLayer.robust()`, degrees; in brackets failures over 5, where any. Its last iterations begin "
        "at its best answer and at six turns about it, so many degrees; at 0 they are seven times the same. Disjoint "
        "sampling, own normals; in Fig. 5 the horse's number is the distractor's points. Processor seconds: 8 degrees.",
        "",
        "| trial | " + " | ".join(f"{turn:g}" for turn in TURNS_DEG) + " | s |",
        "|---" * (len(TURNS_DEG) + 2) + "|",
    ]
    for experiment in EXPERIMENTS:
        figure = experiment.title.partition(":")[0]
        for cell in experiment.cells("disjoint") if experiment.name in CHOSEN else []:
            lines.append(row(cell._replace(panel=f"{figure} {cell.panel}"), options.repeats))
            print(lines[-1], flush=True)
    with atomic_write(options.out) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
