"""The paper's experiments beside today's peers: tables and pictures of errors, failures and seconds.

    python -m benchmarks.paper --peers --repeats 20 --out docs

The whole takes two to three hours, more than half of them for the paper's own variants. Every registration is kept in
the results file as soon as its cell is done: a run that was cut off goes on where it was, and tables and pictures are
drawn from what is there. ``--only fig3`` runs one experiment, ``--draw`` none. The peers want
``pip install '.[peers]'``.
"""

import argparse
from pathlib import Path

import torch

from benchmarks.paper_experiments import EXPERIMENTS
from benchmarks.paper_figures import draw
from benchmarks.paper_methods import METHODS
from benchmarks.paper_results import Bench, Results
from benchmarks.paper_tables import document
from benchmarks.paper_trials import SAMPLINGS
from benchmarks.peers import open3d


def options() -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser(description="the paper's experiments")
    names = [x.name for x in EXPERIMENTS]
    parser.add_argument("--only", nargs="+", choices=names, default=names, help="run these experiments alone")
    parser.add_argument("--sampling", nargs="+", choices=SAMPLINGS, default=SAMPLINGS)
    parser.add_argument("--peers", action="store_true", help="run the peers too")
    parser.add_argument("--repeats", type=int, default=20, help="twice as many in Figs. 6 and 7, half for lidar")
    parser.add_argument("--variant-repeats", type=int, default=20, help="of the paper's four variants, which are slow")
    parser.add_argument("--draw", action="store_true", help="run nothing, only write what the results file holds")
    parser.add_argument("--results", type=Path, default=Path("out/paper_results.json"))
    parser.add_argument("--out", type=Path, default=Path("docs"))
    return parser.parse_args()


def main() -> None:
    """Run what is missing, then write the tables and pictures."""
    asked = options()
    torch.set_num_threads(1)
    asked.results.parent.mkdir(parents=True, exist_ok=True)
    results = Results(asked.results)
    benches = [
        Bench(results, experiment, sampling, asked.repeats, asked.variant_repeats)
        for sampling in reversed(SAMPLINGS)
        for experiment in EXPERIMENTS
    ]
    if asked.peers and not asked.draw:
        open3d()  # before an hour's work, not after
    for bench in [] if asked.draw else benches:
        if bench.experiment.name in asked.only and bench.sampling in asked.sampling:
            cells = bench.experiment.cells(bench.sampling)
            for method in METHODS:
                if method.kind == "ours" or (asked.peers if method.kind == "peer" else asked.variant_repeats):
                    bench.run(method, cells)
    for name in sorted({x.experiment.name for x in benches}):
        draw([x for x in benches if x.experiment.name == name], asked.out)
    document(benches, asked.out / "experiments.md")


if __name__ == "__main__":
    main()
