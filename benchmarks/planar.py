"""How few points should show the way in the plane? Failures, errors, time and gradients of planar registrations.

    python -m benchmarks.planar --out benchmarks/planar.md

Scans: DeepMapping's v1_pose0, the planar pairs of ``benchmarks.reliability_trials``; and pairs of simulated scans of
twelve floor plans, one or two stations apart, 1080 rays with 1 cm of noise. Wrong: more than 5 degrees off, or the
points on average more than a twentieth of the radius. Gradients: an exact copy of a closed curve turned by 20 degrees;
the norm of the gradient of each component of the pose over the analytic sensitivity of the alignment, which is 1.
"""

import argparse
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbr_layer import BBRLayer, Detached, Registration, RigidMotion, Stage
from benchmarks.mapping_rows import simulated
from benchmarks.reliability_runs import errors
from benchmarks.reliability_trials import Clouds, clouds, trials, turned
from train.simulate import WorldSettings

KINDS, PLANS, FIRST_SEED, STATIONS, BEAMS = ("rooms", "loop", "corridor"), 12, 100, 24, 1080
# Target, how many stations farther the source is, degrees it is turned by.
PAIRS = ((0, 1, 5.0), (8, 1, 30.0), (14, 2, 10.0), (18, 2, 30.0), (5, 1, 90.0))
WRONG_DEG, WRONG_SHARE = 5.0, 0.05
FEW = (32, 128, 256)
CURVES, CURVE_SEEDS = (50, 100, 250, 500, 1000, 2000), 4


def layers() -> dict[str, BBRLayer]:
    """What is compared: as they are, with other numbers of points, and as clouds in space are registered."""
    found = {
        "`BBRLayer()`": BBRLayer(),
        "`BBRLayer.fast()`": BBRLayer.fast(),
        "`BBRLayer(starts=1)`": BBRLayer(starts=1),
    }
    for points in FEW:
        found[f"one start, {points} points show the way"] = BBRLayer(*_seeing(points))
    in_space = [Stage(x.loss, x.inner, x.temperature, points=x.points, above=x.above) for x in _stages(3)]
    return found | {
        "one start, as in space": BBRLayer(*in_space),
        "7 starts, as in space": BBRLayer(*in_space, starts=7),
    }


def _stages(dimension: int) -> list[Stage]:
    return [stage for stage in BBRLayer().sequence if stage.dimension == dimension]


def _seeing(points: int) -> list[Stage]:
    *before, last = _stages(2)
    few = [Stage(x.loss, x.inner, x.temperature, points=points) for x in before]
    return [*few, Stage(last.loss, last.inner, last.temperature, above=points)]


def scans() -> dict[str, list[tuple[float, Clouds]]]:
    """By name, pairs of scans and the degrees they are turned by."""
    sparse = [(trial.degrees, clouds(trial)) for trial in trials(4) if trial.group == "2D"]
    return {"v1_pose0": sparse, f"floor plans, {BEAMS} rays": list(_floor_plans())}


def _floor_plans() -> Iterator[tuple[float, Clouds]]:
    for seed in range(PLANS):
        settings = WorldSettings(
            kind=KINDS[seed % len(KINDS)], scans=STATIONS, beams=BEAMS, movers=0, seed=FIRST_SEED + seed
        )
        plan, generator = simulated(settings), torch.Generator().manual_seed(seed)
        for target, step, degrees in PAIRS:
            P, Q = (torch.from_numpy(np.ascontiguousarray(plan.points[k])).double() for k in (target, target + step))
            aligned = RigidMotion.from_matrix(
                torch.from_numpy(np.linalg.inv(plan.truth[target]) @ plan.truth[target + step])
            )
            placed = aligned(Q)
            truth = turned(degrees, placed, generator).inverse()
            yield degrees, Clouds(P, truth.inverse()(placed), truth, None, None)


def row(name: str, data: str, layer: BBRLayer, pairs: list[tuple[float, Clouds]]) -> str:
    """Wrong answers by turn, median errors of the right ones, milliseconds."""
    layer.backward_mode, wrong, right, spent = Detached(), {}, [], 0.0
    for degrees, c in pairs:
        P, Q, *normals = (None if x is None else x.float() for x in (c.P, c.Q, c.P_normals, c.Q_normals))
        before = time.process_time()
        found = layer(P, Q, P_normals=normals[0], Q_normals=normals[1])
        spent += time.process_time() - before
        off, share = errors(c, found.target_from_source)
        missed = off > WRONG_DEG or share > WRONG_SHARE
        wrong.setdefault(degrees, []).append(missed)
        right += [] if missed else [(off, share)]
    by_turn = ", ".join(f"{sum(x)}/{len(x)} at {degrees:g}" for degrees, x in sorted(wrong.items()))
    off, share = np.median(right, axis=0)
    return f"| {data} | {name} | {by_turn} | {off:.4f} | {1e3 * share:.2f} | {1e3 * spent / len(pairs):.0f} |"


def curve(n: int, seed: int) -> Tensor:
    """A closed curve with no symmetry, ``(n, 2)``."""
    directions = torch.randn(n, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    directions = directions / directions.norm(dim=1, keepdim=True)
    bumps = 1 + 0.3 * torch.sin(2 * directions[:, :1] + 1) * torch.cos(3 * directions[:, 1:])
    return directions * bumps * torch.tensor([1.0, 0.7])


def shares_of_sensitivity(layer: BBRLayer, P: Tensor) -> Tensor:
    """For each component of the pose the norm of its gradient by an exact copy over the analytic one, ``(3,)``."""
    turn = torch.tensor([math.radians(20)], dtype=torch.float64)
    Q = RigidMotion.from_rotvec(turn, torch.full((2,), 0.03, dtype=torch.float64)).inverse()(P).requires_grad_()
    result = layer(P, Q)
    wanted = torch.linalg.inv(result.information).diagonal().sqrt()
    return torch.stack([torch.autograd.grad(x, Q, retain_graph=True)[0].norm() for x in tangent(result, Q)]) / wanted


def tangent(result: Registration, Q: Tensor) -> Tensor:
    """Turn from where the answer is, and where the source's centroid goes."""
    motion, centre = result.target_from_source, Q.detach().mean(0)
    here = RigidMotion(motion.rotation @ motion.rotation.detach().mT, torch.zeros_like(motion.translation))
    return torch.cat((here.rotvec, motion.rotation @ centre + motion.translation))


def gradient_row(name: str, layer: BBRLayer) -> str:
    """The least and the largest share for every size of curve."""
    cells = []
    for n in CURVES:
        shares = torch.cat([shares_of_sensitivity(layer, curve(n, seed)) for seed in range(CURVE_SEEDS)])
        cells.append(f"{shares.min():.2g} to {shares.max():.2g}")
    return f"| {name} | " + " | ".join(cells) + " |"


def main() -> None:
    """Write the tables to the file named."""
    parser = argparse.ArgumentParser(description="registrations in the plane")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/planar.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    lines = [
        "Made by `python -m benchmarks.planar`, one thread: wrong answers by degrees of turn; of the right ones the",
        "median error, and how far the points lie from where they belong, in thousandths of the radius; milliseconds.",
        "",
        "| scans | layer | wrong | degrees | thousandths | ms |",
        "|---|---|---|---|---|---|",
    ]
    compared = layers()
    for data, pairs in scans().items():
        for name, layer in compared.items():
            lines.append(row(name, data, layer, pairs))
            print(lines[-1], flush=True)
    lines += ["", "Gradients on exact copies of curves, over the analytic sensitivity, least to largest:", ""]
    lines += ["| layer | " + " | ".join(f"{n} points" for n in CURVES) + " |", "|---" * (len(CURVES) + 1) + "|"]
    for name, layer in layers().items():
        if layer.starts != 7:
            lines.append(gradient_row(name, layer))
            print(lines[-1], flush=True)
    options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
