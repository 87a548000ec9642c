"""How often the default layer fails on large turns, from one start and from seven.

    python -m benchmarks.starts --repeats 20 --out benchmarks/starts.md

Two random subsets of 500 points that share no point, each with normals of its own (none are given), float32; one is
turned about a random axis. Failure is an error over 5 degrees. The two layers see the same trials.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbr_layer import BBRLayer, Detached, RigidMotion, angular_error
from benchmarks.data import model

MODELS = ("bun_zipper", "horse", "dragon_vrip_res3")
ANGLES_DEG = (30.0, 60.0, 90.0)
POINTS = 500
FAILURE_DEG = 5.0


def trial(cloud: Tensor, layer: BBRLayer, degrees: float, seed: int) -> float:
    """Angular error in degrees of one registration."""
    generator = torch.Generator().manual_seed(seed)
    first, second = torch.randperm(len(cloud), generator=generator)[: 2 * POINTS].split(POINTS)
    axis = torch.randn(3, generator=generator, dtype=torch.float64)
    truth = RigidMotion.from_rotvec(axis / axis.norm() * math.radians(degrees), torch.zeros(3, dtype=torch.float64))
    result = layer(truth(cloud[first]).float(), cloud[second].float())
    return math.degrees(angular_error(result.target_from_source.rotation, truth.rotation).item())


def row(name: str, cloud: Tensor, degrees: float, repeats: int) -> str:
    """One table row: failures, median error and processor seconds of both layers."""
    cells = []
    for layer in (BBRLayer(backward=Detached()), BBRLayer.robust(Detached())):
        before = time.process_time()
        errors = np.array([trial(cloud, layer, degrees, seed) for seed in range(repeats)])
        seconds = (time.process_time() - before) / repeats
        cells.append(f"{(errors > FAILURE_DEG).sum()}/{repeats} | {np.median(errors):.3f} | {seconds:.2f}")
    return f"| {name} | {degrees:g} | " + " | ".join(cells) + " |"


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="failures from one start and from seven")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/starts.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        f"Made by `python -m benchmarks.starts --repeats {options.repeats}`: {POINTS} points of each cloud, none "
        "shared, normals estimated from each; failures over 5 degrees, median error in degrees, processor seconds of "
        "one registration on one thread.",
        "",
        "| model | turn, deg | `BBRLayer()`: failures | median | s | `BBRLayer.robust()`: failures | median | s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in MODELS:
        cloud = model(name).double()
        BBRLayer.robust(Detached())(cloud[:50].float(), cloud[50:100].float())  # what is compiled once does not count
        for degrees in ANGLES_DEG:
            lines.append(row(name, cloud, degrees, options.repeats))
            print(lines[-1], flush=True)
            options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
