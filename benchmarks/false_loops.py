"""How many wrong loops does a map survive?

    python -m benchmarks.false_loops [--only v1_pose0 ...] [--again] [--out benchmarks/false_loops.md]

The edges of a sequence are registered once; then wrong loops are added until they are the given share of all loops,
and the pose graph and the refinement are solved again; in the plane also those of a point-to-line ICP. ``scattered``:
between scans drawn at random, each with a motion of its own. ``agreeing``: in groups of four between neighbouring
scans, all of a group leading to the same wrong place along the chain, as rooms that look alike do. A wrong loop has the
information, centre and score of a right edge. Motions: any turn (about the vertical axis), shifts as far as two scan
radii.
"""

import argparse
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from bbr_layer import RigidMotion
from benchmarks.false_loop_solvers import Ours, PointToLineGraph, Solver
from benchmarks.kept import keep, kept_results
from benchmarks.mapping_rivals import LINES
from benchmarks.mapping_rows import ROWS, Row
from train.pose_graph import Edges
from train.scans import ScanSet

CHOSEN = ("v1_pose0, stride 2", "v1_pose0, noise 1 px", "v1_pose0, 180 deg", "balm 30-108, stride 1")
SHARES, KINDS, SEEDS = (0.1, 0.3), ("scattered", "agreeing"), 5
GROUP = 4
OURS, RIVAL = "ours", "point-to-line + graph"


class Wrong(NamedTuple):
    """Which wrong loops: ``share`` of all loops, ``kind``, and the seed they are drawn from."""

    share: float
    kind: str
    seed: int


def wrong_loops(edges: Edges, poses: RigidMotion, reach: float, wrong: Wrong) -> Edges:
    """Wrong loops between the scans of ``poses``, each like a right edge drawn at random but for where it leads.

    ``reach``: radius of a scan, in the data's unit.
    """
    random = np.random.default_rng(wrong.seed)
    right = np.flatnonzero(edges.kind.numpy() == 2)
    count = round(wrong.share / (1 - wrong.share) * len(right))
    drawn: list[tuple[int, int, RigidMotion]] = []
    while len(drawn) < count:
        drawn += _group(poses, reach, GROUP if wrong.kind == "agreeing" else 1, random)
    target, source, motions = zip(*drawn[:count], strict=True)
    return edges.kept(torch.from_numpy(random.choice(right, size=count)))._replace(
        target=torch.tensor(target),
        source=torch.tensor(source),
        target_from_source=RigidMotion(*(torch.stack(field) for field in zip(*motions, strict=True))),
        kind=torch.full((count,), 2),
    )


def _group(
    poses: RigidMotion, reach: float, size: int, random: np.random.Generator
) -> list[tuple[int, int, RigidMotion]]:
    """``size`` wrong loops between neighbouring scans that agree with each other along the poses."""
    k, d = len(poses.translation), poses.dimension
    i, j = np.sort(random.choice(k - size + 1, size=2, replace=False)).tolist()
    turn = torch.zeros(1 if d == 2 else 3, dtype=torch.float64)
    turn[-1] = random.uniform(-np.pi, np.pi)
    shift = torch.from_numpy(random.uniform(-2 * reach, 2 * reach, size=d))
    wrong = RigidMotion.from_rotvec(turn, shift)
    steps = range(size)
    to_target = [poses.between(i + step, i) for step in steps]
    from_source = [poses.between(j, j + step) for step in steps]
    return [(i + step, j + step, to_target[step] @ wrong @ from_source[step]) for step in steps]


def measured(solver: Solver) -> dict[str, list[list[float]]]:
    """By share and kind, ``[error, wrong loops believed, wrong loops]`` of every seed; by ``"0"`` without any."""
    results = {"0": [[solver(solver.edges, 0).error, 0.0, 0.0]]}
    for share, kind, seed in product(SHARES, KINDS, range(SEEDS)):
        print(f"\r{share} {kind} {seed}", end="      ", flush=True)
        more = wrong_loops(solver.edges, solver.poses, solver.reach, Wrong(share, kind, seed))
        found = solver(solver.edges.joined(more), len(more.target))
        results.setdefault(f"{share} {kind}", []).append([found.error, found.believed, len(more.target)])
    return results


def rival(row: Row, scans: ScanSet) -> PointToLineGraph:
    """Point-to-line ICP with a graph, at the setting that is nearer to the truth without wrong loops."""
    solvers = [PointToLineGraph(row, scans, setting, told) for setting in LINES.values()]
    return min(solvers, key=lambda solver: solver(solver.edges, 0).error)


def told(stage: str, done: int, total: int) -> None:
    """Progress, in one line."""
    print(f"\r{stage} {done}/{total}", end="   ", flush=True)


def table(results: dict[str, dict[str, list[list[float]]]]) -> str:
    """One row per sequence, mapper, share and kind."""
    lines = [
        "Made by `python -m benchmarks.false_loops`: wrong loops added to the registered edges until they are the",
        "share of all loops; the pose graph, and of our mapper the refinement, solved again. Errors: median and",
        f"worst of {SEEDS} seeds over the mapper's own error without wrong loops; believed: wrong loops that were, of",
        "all seeds. The rival has its better setting, chosen with the truth, and our graph's robust solver without",
        "the choice among its solutions.",
        "",
        "| sequence | mapper | wrong loops | of all | error without | median | worst | believed |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (name, mapper), found in sorted(_by_mapper(results).items(), key=lambda item: CHOSEN.index(item[0][0])):
        (without, *_), unit = found["0"][0], ROWS[name].unit.name
        for key, seeds in found.items():
            if key == "0":
                continue
            share, kind = key.split()
            ratios = [error / without for error, *_ in seeds]
            believed, count = (int(sum(seed[part] for seed in seeds)) for part in (1, 2))
            cells = (
                f"{float(share):.0%}",
                f"{without:.3g} {unit}",
                f"{np.median(ratios):.3f} x",
                f"{max(ratios):.3f} x",
            )
            lines.append(f"| {name} | {mapper} | {kind} | {' | '.join(cells)} | {believed} of {count} |")
    return "\n".join(lines) + "\n"


def _by_mapper(results: dict[str, dict[str, list[list[float]]]]) -> dict[tuple[str, str], dict[str, list[list[float]]]]:
    """Results by sequence and mapper; what has no mapper beside its name is ours."""
    return {
        (name, mapper or OURS): found for key, found in results.items() for name, _, mapper in [key.partition(" | ")]
    }


def main() -> None:
    """Measure the rows asked for and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], help="rows that begin with one of these")
    parser.add_argument("--again", action="store_true", help="measure rows again that are there")
    parser.add_argument("--out", type=Path, default=Path("benchmarks", "false_loops.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = kept_results(options.out)
    for name in (name for name in CHOSEN if name.startswith(tuple(options.only))):
        row, scans = ROWS[name], ROWS[name].make()
        mappers = {name: lambda row=row, scans=scans: Ours(row, scans, told)}
        if scans.dimension == 2:
            mappers[f"{name} | {RIVAL}"] = lambda row=row, scans=scans: rival(row, scans)
        for key, make in mappers.items():
            if key in results and not options.again:
                continue
            results[key] = measured(make())
            keep(results, table(results), options.out)
    print("\n" + table(results))


if __name__ == "__main__":
    main()
