"""What it brings that pairs count as their points are alike: the default layer with and without its last iterations.

    python -m benchmarks.likeness --repeats 20 --out benchmarks/likeness.md

The trials are those of ``benchmarks.paper`` in both samplings, with seeds from 1000 on.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from bbr_layer import BBRLayer, BuddyFilter, Detached, GaussNewton, Stage, atomic_write
from benchmarks.paper_experiments import EXPERIMENTS, Cell
from benchmarks.paper_results import spread
from benchmarks.paper_trials import SAMPLINGS

CHOSEN = ("fig3", "fig4", "fig5")
FIRST_SEED = 1000


def is_alike(stage: Stage) -> bool:
    """Whether its pairs count as their points are alike."""
    return isinstance(stage.loss, BuddyFilter) and stage.loss.alike


def layers() -> dict[str, BBRLayer]:
    """The default without the stage, with its iterations but all pairs alike in weight, and as it is."""
    stages = list(BBRLayer().sequence)
    plain = [stage for stage in stages if not is_alike(stage)]
    last = next(stage for stage in stages if is_alike(stage))
    assert isinstance(last.loss, BuddyFilter) and isinstance(last.inner, GaussNewton)
    unweighed = Stage(BuddyFilter(reach=last.loss.reach), last.inner, last.temperature, upto=last.upto, dimension=3)
    return {
        "without": BBRLayer(*plain, backward=Detached()),
        "all the same": BBRLayer(*plain, unweighed, backward=Detached()),
        "`BBRLayer()`": BBRLayer(backward=Detached()),
    }


def row(cell: Cell, sampling: str, chosen: dict[str, BBRLayer], repeats: int) -> str:
    """Median and 90th percentile of the angle of each layer, and failures where there are any."""
    degrees = np.zeros((repeats, len(chosen)))
    for number in range(repeats):
        trial = cell.make(FIRST_SEED + number)
        normals = {} if trial.P_normals is None else {"P_normals": trial.P_normals, "Q_normals": trial.Q_normals}
        for column, layer in enumerate(chosen.values()):
            degrees[number, column] = trial.errors(layer(trial.P, trial.Q, **normals).target_from_source)[0]
    return f"| {sampling} | {cell.name} | " + " | ".join(map(spread, degrees.T)) + " |"


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="pairs that count as their points are alike")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/likeness.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    chosen = layers()
    lines = [
        f"Made by `python -m benchmarks.likeness --repeats {options.repeats}`: median / 90th percentile of the angle, "
        "degrees; in brackets failures over 5. `BBRLayer()` without its last ten iterations, with them but all pairs "
        "counting the same, and as it is. In Fig. 5 the horse's number is the distractor's points.",
        "",
        "| sampling | trial | " + " | ".join(chosen) + " |",
        "|---" * (len(chosen) + 2) + "|",
    ]
    for sampling in reversed(SAMPLINGS):
        for experiment in EXPERIMENTS:
            if experiment.name in CHOSEN:
                for cell in experiment.cells(sampling):
                    named = cell._replace(panel=f"{experiment.title.partition(':')[0]} {cell.panel}")
                    lines.append(row(named, sampling, chosen, options.repeats))
                    print(lines[-1], flush=True)
    with atomic_write(options.out) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
