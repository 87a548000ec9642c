"""How often the default layer fails on large turns, from one start and from seven.

    python -m benchmarks.starts --repeats 20 --out benchmarks/starts.md

Models: two random subsets of 500 points that share no point; scans: a subset of each of two of the bunny's range scans,
put in place by the known poses. Normals are each subset's own (none are given), float32; the source is turned about a
random axis, the scans' about its centroid. Failure is an error over 5 degrees. The two layers see the same trials.
"""

import argparse
import math
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbr_layer import BBRLayer, Detached, RigidMotion, angular_error
from benchmarks.data import model, scan

MODELS = ("bun_zipper", "horse", "dragon_vrip_res3")
ANGLES_DEG = (30.0, 60.0, 90.0)
POINTS = 500
# Target, source, degrees from and to, points of each: the paper's Fig. 4 and 7.
SCANS = (
    ("bun000", "bun090", 5.0, 5.0, 200),
    ("bun000", "bun090", 5.0, 5.0, 500),
    ("bun000", "bun090", 5.0, 5.0, 1000),
    ("bun180", "bun270", 30.0, 50.0, 1000),
)
Pair = tuple[Tensor, Tensor, RigidMotion]
FAILURE_DEG = 5.0


def turned_model(cloud: Tensor, degrees: float, seed: int) -> Pair:
    """Target, source and the motion that is sought."""
    generator = torch.Generator().manual_seed(seed)
    first, second = torch.randperm(len(cloud), generator=generator)[: 2 * POINTS].split(POINTS)
    axis = torch.randn(3, generator=generator, dtype=torch.float64)
    truth = RigidMotion.from_rotvec(axis / axis.norm() * math.radians(degrees), torch.zeros(3, dtype=torch.float64))
    return truth(cloud[first]), cloud[second], truth


def turned_scan(target: Tensor, source: Tensor, degrees: tuple[float, float], count: int, seed: int) -> Pair:
    """The same for two scans in one frame."""
    generator = torch.Generator().manual_seed(seed)
    P, Q = (scan[torch.randperm(len(scan), generator=generator)[:count]] for scan in (target, source))
    axis = torch.randn(3, generator=generator, dtype=torch.float64)
    angle = degrees[0] + (degrees[1] - degrees[0]) * torch.rand(1, generator=generator, dtype=torch.float64)
    turn = RigidMotion.from_rotvec(axis / axis.norm() * torch.deg2rad(angle), torch.zeros(3, dtype=torch.float64))
    centre = Q.mean(0)
    truth = RigidMotion(turn.rotation, centre - turn.rotation @ centre).inverse()
    return P, truth.inverse()(Q), truth


def error_and_seconds(layer: BBRLayer, pair: Pair) -> tuple[float, float]:
    """Angular error in degrees of one registration, and the seconds of processor time of the call."""
    P, Q, truth = pair[0].float(), pair[1].float(), pair[2]
    before = time.process_time()
    result = layer(P, Q)
    seconds = time.process_time() - before
    return math.degrees(angular_error(result.target_from_source.rotation, truth.rotation).item()), seconds


def row(name: str, turn: str, make: Callable[[int], Pair], repeats: int) -> str:
    """One table row: failures, median error and processor seconds of both layers."""
    cells = []
    for layer in (BBRLayer(backward=Detached()), BBRLayer.robust(Detached())):
        errors, seconds = np.array([error_and_seconds(layer, make(seed)) for seed in range(repeats)]).T
        cells.append(f"{(errors > FAILURE_DEG).sum()}/{repeats} | {np.median(errors):.3f} | {seconds.mean():.3f}")
    return f"| {name} | {turn} | " + " | ".join(cells) + " |"


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="failures from one start and from seven")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/starts.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        f"Made by `python -m benchmarks.starts --repeats {options.repeats}`: points of each cloud as named, none "
        "shared, normals estimated from each; failures over 5 degrees, median error in degrees, processor seconds of "
        "one registration (mean) on one thread.",
        "",
        "| clouds | turn, deg | `BBRLayer()`: failures | median | s | `BBRLayer.robust()`: failures | median | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in MODELS:
        cloud = model(name).double()
        BBRLayer.robust(Detached())(cloud[:50].float(), cloud[50:100].float())  # what is compiled once does not count
        for degrees in ANGLES_DEG:
            make = partial(turned_model, cloud, degrees)
            lines.append(row(f"{name}, {POINTS}", f"{degrees:g}", make, options.repeats))
            print(lines[-1], flush=True)
    for first, second, low, high, count in SCANS:
        make = partial(turned_scan, scan(first), scan(second), (low, high), count)
        lines.append(
            row(
                f"{first}, {second}, {count}",
                f"{low:g}" if low == high else f"{low:g} to {high:g}",
                make,
                options.repeats,
            )
        )
        print(lines[-1], flush=True)
    options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
