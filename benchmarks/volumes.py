"""Clouds that fill a volume, where everything is near something: does confidence tell strangers from copies?

    python -m benchmarks.volumes --repeats 10 --out benchmarks/volumes.md

Beside them, how well the source of every trial of ``benchmarks.reliability_trials`` fits where it does not belong.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbr_layer import BBRLayer, Detached, RigidMotion, atomic_write
from bbr_layer.confidence import fit_elsewhere, judged_clouds, point_gaps
from bbr_layer.preparation import prepared
from bbr_layer.verdict import BELIEVED
from benchmarks.reliability_runs import as_pair
from benchmarks.reliability_trials import Trial, clouds, trials

SIZES = (120, 300, 800, 2000, 5000)
# Standard deviation of a noisy copy's points, in units of the volumes below.
NOISE = 0.01
# Draws of the trials, as `benchmarks.reliability_runs` has them.
DRAWS = 4
VOLUMES: dict[str, Callable[[int], Tensor]] = {
    "ball": lambda n: in_ball(n, 3),
    "disc": lambda n: in_ball(n, 2),
    "cube": lambda n: torch.rand(n, 3),
    "rod, 6 x 1 x 1": lambda n: torch.rand(n, 3) * torch.tensor([6.0, 1.0, 1.0]),
    "plank, 8 x 3 x 1": lambda n: torch.rand(n, 3) * torch.tensor([8.0, 3.0, 1.0]),
    "slab, 8 x 8 x 1": lambda n: torch.rand(n, 3) * torch.tensor([8.0, 8.0, 1.0]),
    "strip, 6 x 1": lambda n: torch.rand(n, 2) * torch.tensor([6.0, 1.0]),
    "normal": lambda n: torch.randn(n, 3),
    "normal, 4 x 1 x 1": lambda n: torch.randn(n, 3) * torch.tensor([4.0, 1.0, 1.0]),
}


def in_ball(n: int, d: int) -> Tensor:
    """Points spread evenly in the ball of radius 1, ``(n, d)``."""
    return torch.nn.functional.normalize(torch.randn(n, d), dim=-1) * torch.rand(n, 1) ** (1 / d)


def believed(volume: Callable[[int], Tensor], n: int, repeats: int) -> tuple[list[float], list[float]]:
    """Confidences of two draws with nothing in common, and of a draw and its noisy copy."""
    layer, strangers, copies = BBRLayer(backward=Detached()), [], []
    for seed in range(repeats):
        torch.manual_seed(seed)
        P = volume(n)
        strangers.append(layer(P, volume(n)).confidence.item())
        copies.append(layer(P, P + NOISE * torch.randn_like(P)).confidence.item())
    return strangers, copies


def logits_elsewhere(trial: Trial) -> float:
    """Of a trial's true answer."""
    c = clouds(trial)
    frame, pair = prepared(as_pair(c), needs_normals=True, scaled=True)
    truth = RigidMotion(c.truth.rotation.double()[None], c.truth.translation.double()[None])
    seen = judged_clouds(pair)
    return fit_elsewhere(seen, frame.enter(truth), point_gaps(seen)).item()


def volumes_table(repeats: int) -> list[str]:
    """Of each volume and size: strangers believed, their median confidence, and the copies' least."""
    lines = ["| volume | " + " | ".join(f"{n} points" for n in SIZES) + " |", "|---" * (len(SIZES) + 1) + "|"]
    for name, volume in VOLUMES.items():
        cells = []
        for n in SIZES:
            strangers, copies = believed(volume, n, repeats)
            wrong = sum(x > BELIEVED for x in strangers)
            cells.append(f"{wrong}/{repeats}, {np.median(strangers):.2f}; {min(copies):.2f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        print(lines[-1], flush=True)
    return lines


def surfaces_table() -> list[str]:
    """The best fit elsewhere of every group's trials, in logits."""
    best: dict[str, list[float]] = {}
    for trial in trials(DRAWS):
        best.setdefault(trial.group, []).append(logits_elsewhere(trial))
    rows = [f"| {group} | {len(found)} | {max(found):.1f} |" for group, found in sorted(best.items())]
    return ["| group | trials | best fit elsewhere, logits |", "|---|---|---|", *rows]


def main() -> None:
    """Write the table to the file named."""
    parser = argparse.ArgumentParser(description="confidence of clouds that fill a volume")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/volumes.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        f"Made by `python -m benchmarks.volumes --repeats {options.repeats}`, `BBRLayer()`. Of clouds with nothing in",
        f"common: how many are believed (confidence over {BELIEVED}) and their median confidence; after the semicolon",
        f"the least confidence of a cloud and its copy with noise of {NOISE}.",
        "",
        *volumes_table(options.repeats),
        "",
        "The source of every trial of `docs/trust.md` turned away from its true place, as confidence looks at it. Over",
        "-6 logits it would count against an answer.",
        "",
        *surfaces_table(),
    ]
    with atomic_write(options.out) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
