"""Real scans mapped without any starting pose, and the registration terms side by side.

    python -m benchmarks.mapping sequences --out benchmarks/mapping_sequences.md
    python -m benchmarks.mapping terms --out benchmarks/mapping_terms.md

``sequences`` maps DeepMapping's v1_pose0, KITTI 00 and BALM as the main job does, and reports the error of the
edges' map and of the trained one. ``terms`` starts v1_pose0 (every 4th scan) from its true poses shaken by 5 px and
2 degrees, and trains it with every term, same seed and same epochs.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch

from bbr_layer import RigidMotion
from benchmarks.data import data_folder
from train.config import TERMS, EdgeConfig, MapConfig, TrainingConfig
from train.edges import register_edges
from train.evaluate import evaluate_trajectory
from train.poses import embed_poses
from train.scans import ScanSet
from train.training import train_map

# File, dimension, unit per length, name of the unit.
SEQUENCES = {
    "v1_pose0, every scan": ("seq_deepmapping2d_v1_pose0", 2, 512.0, "px"),
    "kitti00 0-15": ("seq_kitti00_0-15", 3, 1.0, "m"),
    "balm 30-108": ("seq_balm_realworld_30-108", 3, 1.0, "m"),
}
SHAKEN_PX, SHAKEN_DEG = 5.0, 2.0
TERM_EPOCHS = 20


def sequence(file: str, dimension: int, stride: int = 1) -> ScanSet:
    """One sequence with its truth, in the first scan's frame."""
    held = np.load(data_folder() / f"{file}.npz")
    bounds, poses = held["offsets"], held["poses"]
    scans = [held["points"][a:b, :dimension].astype(float) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    if dimension == 2:
        poses = poses[:, [0, 1, 3]][:, :, [0, 1, 3]]
    truth = (np.linalg.inv(poses[0]) @ poses)[::stride]
    kept = scans[::stride]
    return ScanSet(kept, [str(i) for i in range(len(kept))], np.arange(len(kept), dtype=float), None, truth)


def ape(poses: RigidMotion, scans: ScanSet) -> float:
    """RMSE of the positions after rigid alignment, in the data's unit."""
    return evaluate_trajectory(embed_poses(poses.matrix.numpy()), embed_poses(scans.truth))["ape_rmse"]


def sequences(names: list[str]) -> list[str]:
    """Rows of the table of sequences."""
    rows = ["| sequence | scans | edges' map | trained | kept epoch | wall seconds |", "|---|---|---|---|---|---|"]
    for name in names:
        file, dimension, unit, word = SEQUENCES[name]
        scans, config, begin = sequence(file, dimension), MapConfig(), time.perf_counter()
        edges, start = register_edges(scans, config.edges)
        trained = train_map(scans, edges, start, config)
        errors = " | ".join(f"{ape(x, scans) * unit:.4f} {word}" for x in (start, trained.world_from_scan))
        rows.append(f"| {name} | {len(scans)} | {errors} | {trained.kept_epoch} | {time.perf_counter() - begin:.0f} |")
        print(rows[-1], flush=True)
    return rows


def shaken(scans: ScanSet, seed: int = 0) -> RigidMotion:
    """The true poses, each but the first turned and moved at random."""
    generator = torch.Generator().manual_seed(seed)
    truth = RigidMotion.from_matrix(torch.from_numpy(scans.truth))
    turn = torch.deg2rad(SHAKEN_DEG * torch.randn(len(scans), 1, generator=generator, dtype=torch.float64))
    move = SHAKEN_PX / 512 * torch.randn(len(scans), 2, generator=generator, dtype=torch.float64)
    turn[0], move[0] = 0, 0
    noise = RigidMotion.from_rotvec(turn, move)
    return RigidMotion(noise.rotation @ truth.rotation, truth.translation + noise.translation)


def terms(names: list[str]) -> list[str]:
    """Rows of the table of terms."""
    scans = sequence("seq_deepmapping2d_v1_pose0", 2, stride=4)
    edges, _ = register_edges(scans, EdgeConfig())
    start = shaken(scans)
    rows = [
        f"The start is {ape(start, scans) * 512:.2f} px off; the edges of `residual` were registered from the scans.",
        "",
        "| term | px after training | kept epoch | wall seconds |",
        "|---|---|---|---|",
    ]
    for name in names:
        training = TrainingConfig(term=name, epochs=TERM_EPOCHS, localisation_rate=3e-3)
        begin = time.perf_counter()
        trained = train_map(scans, edges, start, MapConfig(training=training))
        error = ape(trained.world_from_scan, scans) * 512
        rows.append(f"| {name} | {error:.2f} | {trained.kept_epoch} | {time.perf_counter() - begin:.0f} |")
        print(rows[-1], flush=True)
    return rows


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
    head = f"Made by `python -m benchmarks.mapping {options.table}` on {torch.get_num_threads()} threads."
    options.out.write_text("\n".join([head, "", *rows]) + "\n")


if __name__ == "__main__":
    main()
