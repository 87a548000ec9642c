"""The registration terms from a bad start: v1_pose0 (every 4th scan) from its true poses shaken by 5 px and 2 degrees.

Every term, ``none`` included, has the same start, epochs and rates. With a free correction per scan (``direct``) it is
trained twice: as by default, the poses first adjusted to the map of all scans, and without; with L-Net (``network``)
without. A seed is that of the shaking and of the training.
"""

import time
from collections.abc import Iterator
from functools import cache
from itertools import product
from statistics import median
from typing import Any, NamedTuple

import torch

from bbr_layer import RigidMotion
from benchmarks.mapping_rows import PIXELS, V1, sequence
from train.config import TERMS, EdgeConfig, MapConfig, TrainingConfig
from train.edges import register_edges
from train.evaluate import evaluate_trajectory
from train.pose_graph import Edges
from train.poses import embed_poses
from train.scans import ScanSet
from train.training import train_map

STRIDE = 4
SHAKEN_PX, SHAKEN_DEG = 5.0, 2.0


class Way(NamedTuple):
    """What corrects poses, and whether they are first adjusted to the map of all scans."""

    localisation: str
    adjust: bool

    @property
    def name(self) -> str:
        """As the table calls it."""
        return f"{self.localisation}, adjusted" if self.adjust else self.localisation


WAYS = (Way("direct", False), Way("direct", True), Way("network", False))


def ape(poses: RigidMotion, scans: ScanSet) -> float:
    """RMSE of the positions after rigid alignment, in the data's unit."""
    return evaluate_trajectory(embed_poses(poses.matrix.numpy()), embed_poses(scans.truth))["ape_rmse"]


def shaken(scans: ScanSet, seed: int) -> RigidMotion:
    """The true poses, each but the first turned and moved at random."""
    generator = torch.Generator().manual_seed(seed)
    truth = RigidMotion.from_matrix(torch.from_numpy(scans.truth))
    turn = torch.deg2rad(SHAKEN_DEG * torch.randn(len(scans), 1, generator=generator, dtype=torch.float64))
    move = SHAKEN_PX / PIXELS.scale * torch.randn(len(scans), 2, generator=generator, dtype=torch.float64)
    turn[0], move[0] = 0, 0
    noise = RigidMotion.from_rotvec(turn, move)
    return RigidMotion(noise.rotation @ truth.rotation, truth.translation + noise.translation)


@cache
def _scans() -> tuple[ScanSet, Edges]:
    scans = sequence(V1, STRIDE)
    return scans, register_edges(scans, EdgeConfig())[0]


def trained(way: Way, term: str, seed: int) -> dict[str, Any]:
    """Errors in pixels before and after the training, the epoch that was kept, and seconds."""
    scans, edges = _scans()
    start = shaken(scans, seed)
    training = TrainingConfig(term=term, localisation=way.localisation, adjust=way.adjust)
    begin = time.process_time()
    found = train_map(scans, edges, start, MapConfig(seed=seed, training=training))
    before, after = (ape(poses, scans) * PIXELS.scale for poses in (start, found.world_from_scan))
    return {"start": before, "error": after, "kept": found.kept_epoch, "CPU seconds": time.process_time() - begin}


def measured_terms(
    names: list[str], seeds: dict[str, int], results: dict[str, Any]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """What the results lack of these terms, each when it is measured; ``seeds``: how many, by localisation."""
    for way in WAYS:
        for seed, name in product(range(seeds[way.localisation]), names):
            key = f"{way.name}, {name}, seed {seed}"
            if key not in results:
                yield key, trained(way, name, seed)


def terms_table(results: dict[str, Any]) -> str:
    """The table of what was measured so far: medians and ranges over the seeds."""
    starts = sorted({one["start"] for one in results.values()})
    lines = [
        "Made by `python -m benchmarks.mapping terms`, one thread: v1_pose0, every 4th scan, from its true poses",
        f"shaken by {SHAKEN_PX:g} px and {SHAKEN_DEG:g} degrees, {starts[0]:.2f} to {starts[-1]:.2f} px off. direct: a",
        "free correction per scan; adjusted: first to the map of all scans, as by default; network: L-Net, without",
        "that (`--network 1`). Pixels: median and range over the seeds. The edges of `residual` were registered from",
        "the scans, not from the shaken poses.",
        "",
        "| term | correction | seeds | px after training | range | kept epochs | CPU seconds |",
        "|---|---|---|---|---|---|---|",
    ]
    for way, name in product(WAYS, TERMS):
        found = [one for key, one in results.items() if key.startswith(f"{way.name}, {name}, seed ")]
        if found:
            errors, kept = sorted(one["error"] for one in found), sorted(one["kept"] for one in found)
            cpu = median(one["CPU seconds"] for one in found)
            lines.append(
                f"| {name} | {way.name} | {len(found)} | {median(errors):.3g} | {errors[0]:.3g} to {errors[-1]:.3g} "
                f"| {kept[0]} to {kept[-1]} | {cpu:.0f} |"
            )
    return "\n".join(lines) + "\n"
