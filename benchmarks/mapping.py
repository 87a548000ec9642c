"""Real scans mapped without any starting pose, and the registration terms side by side.

    python -m benchmarks.mapping sequences --out benchmarks/mapping_sequences.md
    python -m benchmarks.mapping terms --out benchmarks/mapping_terms.md

``sequences`` writes DeepMapping's v1_pose0 (PCD), KITTI 00 and BALM (PLY) as folders of scans beside a file of their
true poses, maps each folder as ``python -m train map`` does, and reports the error of the edges' map and of the
trained one; the truth is read for that alone. Scans, maps and pictures stay in ``out/benchmark``. ``terms`` starts
v1_pose0 (every 4th scan) from its true poses shaken by 5 px and 2 degrees, and trains it with every term, same seed,
epochs and rates, once with a free correction per scan and once with L-Net.
"""

import argparse
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from bbr_layer import RigidMotion, write_cloud, write_poses_tum
from benchmarks.data import data_folder
from train.config import TERMS, EdgeConfig, MapConfig, TrainingConfig
from train.console import PrintedUnit
from train.edges import register_edges
from train.evaluate import evaluate_trajectory
from train.mapping import map_scans
from train.poses import embed_poses
from train.run_folder import open_run
from train.scans import ScanSet, read_scan_set
from train.training import train_map


class Sequence(NamedTuple):
    """A file of scans, the format they are written in, and the unit of the errors in the table."""

    file: str
    suffix: str
    unit: PrintedUnit


class Clock:
    """Time since it was made: of the wall, which other work on the machine stretches, and of the processors."""

    def __init__(self) -> None:
        self.begin = time.perf_counter(), time.process_time()

    def columns(self) -> str:
        """Seconds of both kinds, as cells of a table."""
        return f"{time.perf_counter() - self.begin[0]:.0f} | {time.process_time() - self.begin[1]:.0f}"


SEQUENCES = {
    "v1_pose0, every scan": Sequence("seq_deepmapping2d_v1_pose0", ".pcd", PrintedUnit(512.0, "px")),
    "kitti00 0-15": Sequence("seq_kitti00_0-15", ".ply", PrintedUnit(1.0, "m")),
    "balm 30-108": Sequence("seq_balm_realworld_30-108", ".ply", PrintedUnit(1.0, "m")),
}
WORK = Path("out", "benchmark")
SHAKEN_PX, SHAKEN_DEG = 5.0, 2.0
LOCALISATIONS = ("direct", "network")


def as_folder(chosen: Sequence, work: Path, stride: int = 1) -> tuple[Path, Path]:
    """Scans written as files of a folder, each in its sensor's frame, and their true poses as a file beside it."""
    held = np.load(data_folder() / f"{chosen.file}.npz", allow_pickle=False)
    scans, truth = work / "scans", work / "truth_tum.txt"
    scans.mkdir(parents=True, exist_ok=True)
    bounds, poses = held["offsets"], held["poses"].astype(float)
    for number in range(0, len(poses), stride):
        points = held["points"][bounds[number] : bounds[number + 1]]
        write_cloud(scans / f"{number:04d}{chosen.suffix}", points)
    kept = (np.linalg.inv(poses[0]) @ poses)[::stride]
    write_poses_tum(truth, kept, np.arange(len(kept), dtype=float))
    return scans, truth


def ape(poses: RigidMotion, scans: ScanSet) -> float:
    """RMSE of the positions after rigid alignment, in the data's unit."""
    return evaluate_trajectory(embed_poses(poses.matrix.numpy()), scans.truth)["ape_rmse"]


def sequences(names: list[str]) -> Iterator[str]:
    """Rows of the table of sequences, each when it is measured."""
    yield from (
        "| sequence | scans | edges' map | trained | kept epoch | seconds | CPU seconds |",
        "|---|---|---|---|---|---|---|",
    )
    for name in names:
        chosen, config = SEQUENCES[name], MapConfig()
        work = WORK / chosen.file
        folder, truth = as_folder(chosen, work)
        clock = Clock()
        scans = read_scan_set([folder], truth=truth)
        run = open_run(work / "map", scans, config, overwrite=True)
        mapped = map_scans(run, scans, config, unit=chosen.unit.of_files)
        took = clock.columns()
        poses = (mapped.start, RigidMotion.from_matrix(torch.from_numpy(mapped.result.world_from_scan)))
        errors = " | ".join(chosen.unit.length(ape(x, scans)) for x in poses)
        yield f"| {name} | {len(scans)} | {errors} | {mapped.kept_epoch} | {took} |"


def shaken(scans: ScanSet, seed: int = 0) -> RigidMotion:
    """The true poses, each but the first turned and moved at random."""
    generator = torch.Generator().manual_seed(seed)
    truth = RigidMotion.from_matrix(torch.from_numpy(scans.truth))
    turn = torch.deg2rad(SHAKEN_DEG * torch.randn(len(scans), 1, generator=generator, dtype=torch.float64))
    move = SHAKEN_PX / 512 * torch.randn(len(scans), 2, generator=generator, dtype=torch.float64)
    turn[0], move[0] = 0, 0
    noise = RigidMotion.from_rotvec(turn, move)
    return RigidMotion(noise.rotation @ truth.rotation, truth.translation + noise.translation)


def terms(names: list[str]) -> Iterator[str]:
    """Rows of the table of terms, each when it is measured."""
    folder, truth = as_folder(SEQUENCES["v1_pose0, every scan"], WORK / "terms", stride=4)
    scans = read_scan_set([folder], truth=truth)
    edges, _ = register_edges(scans, EdgeConfig())
    start = shaken(scans)
    yield f"The start is {ape(start, scans) * 512:.2f} px off; the edges of `residual` were registered from the scans."
    yield from (
        "",
        "| term | localisation | px after training | kept epoch | seconds | CPU seconds |",
        "|---|---|---|---|---|---|",
    )
    for localisation, name in product(LOCALISATIONS, names):
        training = TrainingConfig(term=name, localisation=localisation)
        clock = Clock()
        trained = train_map(scans, edges, start, MapConfig(training=training))
        error = ape(trained.world_from_scan, scans) * 512
        yield f"| {name} | {localisation} | {error:.2f} | {trained.kept_epoch} | {clock.columns()} |"


def main() -> None:
    """Write the table asked for to the file named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=["sequences", "terms"])
    parser.add_argument("--only", nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.table == "sequences":
        rows = sequences(options.only or list(SEQUENCES))
    else:
        rows = terms(options.only or list(TERMS))
    threads = torch.get_num_threads()
    head = f"Made by `python -m benchmarks.mapping {options.table}` on {threads} thread{'s' * (threads > 1)}."
    lines = [head, ""]
    for row in rows:
        print(row, flush=True)
        lines.append(row)
        options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
