"""How far F should reach: the default layer's error with several, on trials that no other table of ours has.

    python -m benchmarks.reach --repeats 20 --out benchmarks/reach.md

The trials are those of ``benchmarks.paper``, disjoint sampling, with seeds from 1000 on.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch

from bbr_layer import BBRLayer, BuddyFilter, Detached, atomic_write
from benchmarks.paper_experiments import EXPERIMENTS, Cell

REACHES = (math.inf, 170.0, 100.0, 50.0, 27.0)
CHOSEN = ("fig3", "fig4", "fig5")
FIRST_SEED = 1000


def layer_of(reach: float) -> BBRLayer:
    """The default with another reach of F, but for the stage that F begins with."""
    layer = BBRLayer(backward=Detached())
    for stage in layer.sequence:
        if isinstance(stage.loss, BuddyFilter) and math.isfinite(stage.loss.reach):
            stage.loss.reach = reach
    return layer


def row(cell: Cell, layers: list[BBRLayer], repeats: int) -> str:
    """Median and 90th percentile of the angle for every reach."""
    degrees = np.zeros((repeats, len(layers)))
    for number in range(repeats):
        trial = cell.make(FIRST_SEED + number)
        for column, layer in enumerate(layers):
            result = layer(trial.P.float(), trial.Q.float())
            degrees[number, column] = trial.errors(result.target_from_source)[0]
    middle, high = np.quantile(degrees, (0.5, 0.9), axis=0)
    return f"| {cell.name} | " + " | ".join(f"{a:.3f} / {b:.3f}" for a, b in zip(middle, high, strict=True)) + " |"


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="the reach of F")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/reach.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    layers = [layer_of(reach) for reach in REACHES]
    lines = [
        f"Made by `python -m benchmarks.reach --repeats {options.repeats}`: median / 90th percentile of the angle in "
        "degrees, `BBRLayer()` with other reaches of F, in temperatures; disjoint sampling, own normals. In Fig. 5 the "
        "horse's number is the distractor's points.",
        "",
        "| trial | " + " | ".join("infinite" if math.isinf(x) else f"{x:g}" for x in REACHES) + " |",
        "|---" * (len(REACHES) + 1) + "|",
    ]
    for experiment in EXPERIMENTS:
        if experiment.name in CHOSEN:
            for cell in experiment.cells("disjoint"):
                named = cell._replace(panel=f"{experiment.title.partition(':')[0]} {cell.panel}")
                lines.append(row(named, layers, options.repeats))
                print(lines[-1], flush=True)
    with atomic_write(options.out) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
