"""Scenes on which the sweeps in Triton are held to those in torch; run as a script, it prints the errors as JSON."""

import json
import math
import sys
from typing import Any, NamedTuple

import torch
from problems import noisy_pair

from bbr_layer import CloudPair
from bbr_layer.kernels.reference import soft_directional, soft_gradient
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms

EPS = 1e-3
# Fields of a scene and a direction that are float64 whatever the points are; both name alpha alike.
HELD = ("temperature", "rounding")
# The side of a tile in the interpreter, which is slow per operation, however many numbers it is on.
TILE = 32


class Problem(NamedTuple):
    """A loss on two clouds of ``n`` and ``m`` points in ``d`` dimensions; ``smoothing`` is a length."""

    terms: SoftTerms
    d: int
    n: int
    m: int
    smoothing: float = 0.0
    masks: bool = False
    weights: bool = True
    alpha: float = 0.5
    batch: int = 1


# No size divides a tile; in one problem several tiles are needed both ways.
PROBLEMS = {
    "softBBS": Problem(SoftTerms(False, outlier=EPS), 3, 9, 11),
    "softBD": Problem(SoftTerms(True, outlier=EPS), 2, 13, 21, smoothing=0.2, masks=True, batch=2),
    "softBD, tiles": Problem(SoftTerms(True, outlier=1e-10), 3, 37, 53, weights=False),
    "softBD, cold": Problem(SoftTerms(True, outlier=1e-10), 2, 9, 11, alpha=0.01),
    "N": Problem(SoftTerms(True, planes=True, outlier=EPS), 3, 13, 21, smoothing=0.2, masks=True, batch=2),
    "N, flat": Problem(SoftTerms(True, planes=True, outlier=EPS), 2, 9, 11),
    "N, signs as given": Problem(SoftTerms(True, planes=True, align_signs=False, outlier=EPS), 3, 9, 11),
}
PRECISIONS = ("float64", "float32")
# What the interpreter has time for: the same code is run in both precisions.
SINGLE = ("softBD, cold", "N")
INTERPRETED = [(name, "float64") for name in PROBLEMS] + [(name, "float32") for name in SINGLE]


def scene_of(problem: Problem) -> tuple[Scene, Direction]:
    """A scene in float64, in which the first points coincide, with a direction."""
    terms, d, n, m, smoothing, masks, weights, alpha, batch = problem
    given = noisy_pair(d, batch, n, m)
    given["Q"][:, 0] = given["P"][:, 0]
    if masks:
        given["P_mask"], given["Q_mask"] = torch.rand(batch, n) > 0.2, torch.rand(batch, m) > 0.2
    if not weights:
        del given["P_weights"], given["Q_weights"]
    lengths = torch.tensor([[alpha, smoothing], [0.6 * alpha, 2 * smoothing]], dtype=torch.float64)[:batch]
    turn, tilt = torch.randn(2, batch, m, d, dtype=torch.float64)
    direction = Direction(turn, tilt if terms.planes else None, torch.randn(batch, dtype=torch.float64))
    return Scene(CloudPair(**given), *lengths.T), direction


def cast(values: Any, dtype: torch.dtype, device: str) -> Any:
    """A scene or a direction with its points in ``dtype``; alpha and rounding stay float64."""
    fields = values._asdict()
    for name, x in fields.items():
        if isinstance(x, CloudPair):
            fields[name] = cast(x, dtype, device)
        elif x is not None:
            fields[name] = x.to(device, x.dtype if name in HELD or x.dtype == torch.bool else dtype)
    return type(values)(**fields)


def relative_error(found: Any, wanted: Any) -> float:
    """The largest error of any field, relative to the largest number in it."""
    if isinstance(wanted, tuple):
        return max(relative_error(f, w) for f, w in zip(found, wanted, strict=True))
    if wanted is None or found is None:
        return 0.0 if wanted is None and found is None else math.inf
    if found.shape != wanted.shape or not found.isfinite().all():
        return math.inf
    return float((found.cpu().double() - wanted).abs().max() / wanted.abs().max().clamp(min=1e-30))


def error(name: str, precision: str, device: str) -> float:
    """The largest error of loss, gradient, and derivative along a direction, against torch in float64."""
    from bbr_layer.kernels import gpu  # not before: who only wants the names may do without Triton

    torch.manual_seed(0)
    problem, dtype = PROBLEMS[name], getattr(torch, precision)
    scene, direction = (cast(x, dtype, device) for x in scene_of(problem))
    exact, along = (cast(x, torch.float64, "cpu") for x in (scene, direction))
    assert not gpu.lacks(problem.terms, scene)
    found = gpu.gradient(problem.terms, scene), gpu.directional(problem.terms, scene, direction)
    assert all(x.dtype == dtype for answer in (found[0][1], *found[1]) for x in answer.pair if x is not None)
    return relative_error(found, (soft_gradient(problem.terms, exact), soft_directional(problem.terms, exact, along)))


def main() -> None:
    """Print whether Triton was imported unasked, and [problem, precision, error] of every problem, on the processor."""
    unasked = "triton" in sys.modules
    from triton.language import constexpr

    from bbr_layer.kernels import gpu_pairs

    gpu_pairs.OWN = gpu_pairs.OTHER = constexpr(TILE)
    errors = [(*which, error(*which, "cpu")) for which in INTERPRETED]
    json.dump({"unasked": unasked, "errors": errors}, sys.stdout)


if __name__ == "__main__":
    main()
