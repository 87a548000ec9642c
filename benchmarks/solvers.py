"""Adam and Gauss-Newton inside: failures, accuracy and time of a registration, and how far its gradient can be trusted.

    python -m benchmarks.solvers --repeats 20 --out benchmarks/solvers.md

Trials as in ``benchmarks.starts``: two random subsets of 500 points of one model that share no point, float32, normals
of their own. Gradients: subsets of 100 to 500 points of the bunny, float64, turned by 15 degrees, the source another
subset or an exact copy; the derivative of a fixed mix of the pose's six numbers along 12 random directions of all
coordinates, against central differences. Their step is 1e-9 m of directions with unit components, on a cloud of 5 cm:
at larger ones buddies change hands between the two sides.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbr_layer import BBRLayer, Detached, GaussNewton, RigidMotion
from benchmarks.data import model
from benchmarks.starts import ANGLES_DEG, FAILURE_DEG, MODELS, error_and_seconds, turned_model

SIZES = (100, 300, 500)
DIRECTIONS, STEP = 12, 1e-9
RADIUS = 0.05  # metres, the bunny's; a translation counts in these


def layers() -> dict[str, BBRLayer]:
    """What is compared."""
    found = {"`BBRLayer()`": BBRLayer(), "`BBRLayer.fast()`": BBRLayer.fast()}
    for name in ("softBBS", "softBD", "F"):
        found[f'`BBRLayer("{name}")`'] = BBRLayer(name)
        steps = 20 if name == "F" else 40
        found[f'`BBRLayer("{name}", inner=GaussNewton({steps}))`'] = BBRLayer(name, inner=GaussNewton(steps))
    return found


def registrations(layer: BBRLayer, degrees: float, repeats: int) -> tuple[str, float]:
    """Failures and median error over all models, and seconds of processor time per registration."""
    layer.backward_mode = Detached()
    clouds = [model(name).double() for name in MODELS]
    trials = (turned_model(cloud, degrees, seed) for cloud in clouds for seed in range(repeats))
    errors, seconds = np.array([error_and_seconds(layer, trial) for trial in trials]).T
    return f"{(errors > FAILURE_DEG).sum()}/{len(errors)} | {np.median(errors):.3f}", float(seconds.mean())


def gradient_row(layer: BBRLayer, P: Tensor, Q: Tensor) -> str:
    """Cosine and ratio of lengths of the derivatives along random directions and central differences."""
    draw = torch.Generator().manual_seed(5)
    mix = torch.randn(6, generator=draw, dtype=torch.float64)

    def pose(P: Tensor, Q: Tensor) -> Tensor:
        found = layer(P, Q).target_from_source
        return (torch.cat((found.rotvec, found.translation / RADIUS)) * mix).sum()

    leaves = P.clone().requires_grad_(), Q.clone().requires_grad_()
    gradients = torch.autograd.grad(pose(*leaves), leaves)
    pairs = []
    for _ in range(DIRECTIONS):
        along = [torch.randn(x.shape, generator=draw, dtype=torch.float64) for x in (P, Q)]
        ahead, behind = (pose(*(x + s * STEP * a for x, a in zip((P, Q), along, strict=True))) for s in (1, -1))
        own = sum((g * a).sum().item() for g, a in zip(gradients, along, strict=True))
        pairs.append((own, (ahead - behind).item() / (2 * STEP)))
    own, wanted = np.array(pairs).T
    cosine = own @ wanted / np.linalg.norm(own) / np.linalg.norm(wanted)
    return f"{cosine:.4f} | {np.linalg.norm(own) / np.linalg.norm(wanted):.4f}"


def gradient_table() -> list[str]:
    """One row per layer, size and kind of source."""
    lines = ["| layer | points | source | cosine | length / central differences |", "|---|---|---|---|---|"]
    cloud, axis = model("bun_zipper").double(), torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    turn = RigidMotion.from_rotvec(math.radians(15) * axis, torch.tensor([0.01, 0.0, 0.02], dtype=torch.float64))
    for name, layer in (("`BBRLayer()`", BBRLayer()), ("`BBRLayer.fast()`", BBRLayer.fast())):
        for n in SIZES:
            P, other = cloud[torch.randperm(len(cloud), generator=torch.Generator().manual_seed(n))[: 2 * n]].split(n)
            for kind, source in (("another sample", other), ("exact copy", P)):
                row = gradient_row(layer, P, turn.inverse()(source))
                lines.append(f"| {name} | {n} | {kind} | {row} |")
                print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Write the tables to the file named."""
    parser = argparse.ArgumentParser(description="Adam and Gauss-Newton")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/solvers.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        f"Made by `python -m benchmarks.solvers --repeats {options.repeats}`: bunny, horse and dragon, 500 points, "
        "none shared, own normals; failures over 5 degrees / registrations and median error in degrees by turn; "
        "processor milliseconds of one, one thread, forward only, mean of all.",
        "",
        "| layer | " + " | ".join(f"{angle:g} deg: failures | median" for angle in ANGLES_DEG) + " | ms |",
        "|---|" + "---|---|" * len(ANGLES_DEG) + "---|",
    ]
    for name, layer in layers().items():
        cloud = model(MODELS[0]).float()
        layer(cloud[:500], cloud[500:1000])  # what is compiled once does not count
        cells = [registrations(layer, angle, options.repeats) for angle in ANGLES_DEG]
        seconds = np.mean([cell[1] for cell in cells])
        lines.append(f"| {name} | " + " | ".join(cell[0] for cell in cells) + f" | {1000 * seconds:.0f} |")
        print(lines[-1], flush=True)
    lines += ["", *gradient_table()]
    options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
