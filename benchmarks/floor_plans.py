"""Does training bring the trajectory nearer to the truth than the registered edges alone, on simulated floor plans?

    python -m benchmarks.floor_plans [--seeds 20] [--out benchmarks/floor_plans.md]

Every seed is another building and another walk: 48 scans of 180 rays, no starting poses; the truth is read for the
errors alone. The seeds begin at 100: none was looked at while the mapper was made. First the default configuration but
for 10 epochs. Then, with noise and movers, every term by itself: the default's 40 epochs from the edges' poses, without
adjusting them to the map of all scans, and the last poses are kept, better or not. What
``out/benchmark/floor_plans.json`` already holds is not measured again.
"""

import argparse
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import torch

from bbr_layer import RigidMotion
from benchmarks.kept import keep, kept_results
from benchmarks.mapping_rows import simulated
from train.config import EdgeConfig, MapConfig, TrainingConfig
from train.edges import register_edges
from train.evaluate import evaluate_trajectory
from train.poses import embed_poses
from train.scans import ScanSet
from train.simulate import WorldSettings
from train.training import train_map

SCANS, RAYS, FIRST_SEED = 48, 180, 100
# Standard deviation of the ranges in metres, and people and trolleys.
CONDITIONS = {"noise": (0.03, 0), "movers": (0.01, 6), "noise and movers": (0.03, 6)}
COMPARED_IN = "noise and movers"
TERMS = ("residual", "softBD", "F", "softBBS", "none", "chamfer", "trimmed_chamfer", "geman_mcclure_chamfer")
EDGES, MAIN = "edges alone", "trained"
# Ways of training by name.
WAYS = {MAIN: TrainingConfig(epochs=10)} | {
    term: TrainingConfig(term=term, adjust=False, keep="last") for term in TERMS
}
# Millimetres of a metre.
MM = 1000.0
Found = dict[str, dict[str, float]]


def floor_plan(condition: str, seed: int) -> ScanSet:
    """Planar scans in metres with their true poses, the first at the origin."""
    noise, movers = CONDITIONS[condition]
    return simulated(WorldSettings(scans=SCANS, beams=RAYS, noise_m=noise, movers=movers, seed=seed))


def ate(poses: RigidMotion, scans: ScanSet) -> float:
    """RMSE of the positions after rigid alignment, millimetres."""
    return evaluate_trajectory(embed_poses(poses.matrix.numpy()), embed_poses(scans.truth))["ape_rmse"] * MM


def measured(condition: str, seed: int, ways: list[str]) -> Iterator[tuple[str, dict[str, float]]]:
    """Error and CPU seconds of the edges alone, then of each way of training."""
    scans = floor_plan(condition, seed)
    begin = time.process_time()
    edges, start = register_edges(scans, EdgeConfig())
    yield EDGES, {"ate": ate(start, scans), "cpu": time.process_time() - begin}
    for way in ways:
        begin = time.process_time()
        trained = train_map(scans, edges, start, MapConfig(training=WAYS[way]))
        found = {"ate": ate(trained.world_from_scan, scans), "cpu": time.process_time() - begin}
        yield way, found | {"kept": trained.kept_epoch}


def rows(results: dict[str, Found], condition: str, names: list[str]) -> Iterator[str]:
    """One row for each way that was measured: medians over the seeds that have it."""
    for name in names:
        seeds = [found for key, found in results.items() if key.startswith(f"{condition}, ") and name in found]
        if not seeds:
            continue
        ates = [found[name]["ate"] for found in seeds]
        ratios = [found[name]["ate"] / found[EDGES]["ate"] for found in seeds]
        reached = median(ates) / median(found[EDGES]["ate"] for found in seeds)
        cpu = median(found[name]["cpu"] for found in seeds)
        worse = sum(ratio > 1 for ratio in ratios)
        yield (
            f"| {condition} | {name} | {len(seeds)} | {median(ates):.1f} | {reached:.2f} | {median(ratios):.2f} "
            f"| {max(ratios):.2f} | {worse} | {cpu:.1f} |"
        )


def table(results: dict[str, Found]) -> str:
    """The whole text."""
    first, second = WAYS[MAIN].epochs, WAYS[TERMS[0]].epochs
    titles = [
        "| condition | way | seeds | ATE, mm | ratio | seeds' ratio | largest | worse | CPU seconds |",
        "|---" * 9 + "|",
    ]
    lines = [
        f"Made by `python -m benchmarks.floor_plans`, one thread: {SCANS} scans of {RAYS} rays, the default\n"
        f"configuration but for {first} epochs. Noise: 30 mm (10 mm with movers alone); movers: 6. ATE: RMSE of the\n"
        "positions after rigid alignment, mm, median over the seeds; ratio: to the edges alone, of the medians, then\n"
        "the median and the largest of the seeds' own; worse: seeds that ended farther off; CPU seconds: of that step.",
        "",
        *titles,
    ]
    for condition in CONDITIONS:
        lines += rows(results, condition, [EDGES, MAIN])
    lines += [
        "",
        f"Every term by itself, {COMPARED_IN}: {second} epochs from the edges' poses, not adjusted; the last poses\n"
        "are kept, better or not, where the default would have kept the edges'.",
        "",
        *titles,
        *rows(results, COMPARED_IN, [EDGES, *TERMS]),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Measure what is missing and write the table after each measurement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks", "floor_plans.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    results: dict[str, Found] = kept_results(options.out)
    ways = {condition: [MAIN, *(TERMS if condition == COMPARED_IN else ())] for condition in CONDITIONS}
    jobs = [(condition, FIRST_SEED + n, ways[condition]) for n in range(options.seeds) for condition in CONDITIONS]
    for number, (condition, seed, wanted) in enumerate(jobs):
        found = results.setdefault(f"{condition}, seed {seed}", {})
        missing = [way for way in wanted if way not in found]
        for name, one in measured(condition, seed, missing) if missing else ():
            found[name] = one
            told = f"{number + 1}/{len(jobs)} {condition}, seed {seed}, {name}: {one['ate']:.1f} mm, {one['cpu']:.1f} s"
            print(told, flush=True)
            keep(results, table(results), options.out)


if __name__ == "__main__":
    main()
