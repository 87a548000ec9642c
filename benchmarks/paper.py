"""The paper's Fig. 2 on the Stanford bunny: failures and accuracy of the four variants against the initial rotation.

    python -m benchmarks.paper --repeats 3 --out benchmarks/paper_fig2.md

Two random subsets of 500 points, one rotated about a random axis, normals of 13 neighbours in the full cloud shared by
both, as in the paper; failure is an error over 5 degrees. The default layer stands beside the four variants.
"""

import argparse
import math
import time
from pathlib import Path
from statistics import mean

import torch
from torch import Tensor

from bbr_layer import BBRLayer, Detached, RigidMotion, angular_error, estimate_normals
from benchmarks.data import model

POINTS = 500
FAILURE_DEG = 5.0
PAPER_NEIGHBOURS = 13


def trial(cloud: Tensor, normals: Tensor, layer: BBRLayer, degrees: float, seed: int) -> float:
    """Angular error in degrees of one registration."""
    generator = torch.Generator().manual_seed(seed)
    first, second = (torch.randperm(len(cloud), generator=generator)[:POINTS] for _ in range(2))
    axis = torch.randn(3, generator=generator, dtype=torch.float64)
    truth = RigidMotion.from_rotvec(axis / axis.norm() * math.radians(degrees), torch.zeros(3, dtype=torch.float64))
    result = layer(
        truth(cloud[first]), cloud[second], P_normals=truth.rotate(normals[first]), Q_normals=normals[second]
    )
    return math.degrees(angular_error(result.target_from_source.rotation, truth.rotation).item())


def cell(cloud: Tensor, normals: Tensor, layer: BBRLayer, degrees: float, repeats: int) -> str:
    """Failures, mean error of the successes, and CPU seconds per registration."""
    before = time.process_time()
    errors = [trial(cloud, normals, layer, degrees, seed) for seed in range(repeats)]
    seconds = (time.process_time() - before) / repeats
    successes = [e for e in errors if e <= FAILURE_DEG]
    accuracy = f"{mean(successes):.3f}" if successes else "-"
    return f"{len(errors) - len(successes)}/{repeats}, {accuracy}, {seconds:.1f} s"


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="Fig. 2 of the paper")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--angles", type=float, nargs="+", default=[10.0, 30.0, 60.0, 90.0])
    parser.add_argument("--out", type=Path, default=Path("benchmarks/paper_fig2.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    cloud = model("bun_zipper")
    cloud, normals = cloud.double(), estimate_normals(cloud, PAPER_NEIGHBOURS)
    layers = {f"paper {name}": BBRLayer.paper(name, Detached()) for name in ("softBBS", "softBD", "N", "F")}
    layers["BBRLayer()"] = BBRLayer(backward=Detached())
    lines = [
        f"Made by `python -m benchmarks.paper --repeats {options.repeats}`: Stanford bunny, {POINTS} points, shared "
        "normals of the full cloud. Each cell: failures over 5 degrees / repeats, mean error of the successes in "
        "degrees, CPU seconds per registration on one thread.",
        "",
        "| layer | " + " | ".join(f"{angle:g} deg" for angle in options.angles) + " |",
        "|---|" + "---|" * len(options.angles),
    ]
    for name, layer in layers.items():
        cells = [cell(cloud, normals, layer, angle, options.repeats) for angle in options.angles]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
        options.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
