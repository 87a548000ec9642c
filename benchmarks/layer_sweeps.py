"""How fast the compiled sweeps are against the processor's own primitives."""

import time
from collections.abc import Callable
from functools import partial

import numba
import numpy as np
import torch

from bbr_layer.kernels import cpu
from bbr_layer.kernels.cpu_batch import DUAL, GRADIENT, room_to_keep
from bbr_layer.kernels.cpu_compiling import FAST
from bbr_layer.kernels.cpu_math import exp_negative, wide_vectors
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms
from bbr_layer.pair import CloudPair
from benchmarks.layer_problems import clouds

PRIMITIVES_NOTE = (
    "Nanoseconds per pair on one thread, n = m = 1000, float32. The bound is what the arithmetic of a gradient alone "
    "costs on this machine, each part measured over an array in the first cache: three exponentials with their square "
    "roots, one division, and 30 fused multiply-adds. Each sweep as a walk calls it, with room for what it keeps. "
    "Far: half of the pairs 33 to 58 temperatures apart, where float32 products fall below the smallest normal number."
)
NUMBERS = 2048  # float32 numbers of one array of the primitives: 8 KiB
REPEATS = 7
# Temperatures in radii of the sphere: of all rows but one, and the one at which most pairs are far apart.
NEAR, FAR = 0.1, 0.03


def best(function: Callable[[], object], inner: int) -> float:
    """Seconds of one call: the best of a few runs of ``inner`` calls."""
    function()
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        for _ in range(inner):
            function()
        times.append((time.perf_counter() - begin) / inner)
    return min(times)


@numba.njit(fastmath=FAST, error_model="numpy")
def exp_root(x, out):  # type: ignore[no-untyped-def]
    """exp(-sqrt(x)), the core of every sweep."""
    wide_vectors()
    for _ in range(100):
        for i in range(x.size):
            out[i] += exp_negative(-np.sqrt(x[i]))


@numba.njit(fastmath=FAST, error_model="numpy")
def divide(x, out):  # type: ignore[no-untyped-def]
    """A division per number."""
    wide_vectors()
    for _ in range(100):
        for i in range(x.size):
            out[i] += np.float32(1) / x[i]


@numba.njit(fastmath=FAST, error_model="numpy")
def multiply_add(x, out):  # type: ignore[no-untyped-def]
    """Ten fused multiply-adds per number, in a chain that other numbers' chains overlap with."""
    wide_vectors()
    a = np.float32(0.999)
    for _ in range(100):
        for i in range(x.size):
            y = x[i]
            y = y * a + x[i]
            y = y * y + x[i]
            y = y * a + y
            y = y * y + a
            y = y * x[i] + a
            y = y * y + x[i]
            y = y * a + x[i]
            y = y * y + a
            y = y * x[i] + y
            out[i] += y * y + a


def sweep_rows() -> list[str]:
    """Gradient and directional derivative of softBD and N beside the primitives."""
    torch.set_num_threads(1)
    x = np.random.default_rng(0).random(NUMBERS).astype(np.float32) + np.float32(0.5)
    out = np.zeros_like(x)
    root, division, ten = (
        best(lambda f=f: f(x, out), 20) / (100 * NUMBERS) * 1e9 for f in (exp_root, divide, multiply_add)
    )
    bound = 3 * root + division + 3 * ten
    rows = ["| what | ns per pair | over the bound |", "|---|---|---|"]
    rows.append(f"| exponential with square root | {root:.2f} | |")
    rows.append(f"| division | {division:.2f} | |")
    rows.append(f"| ten multiply-adds | {ten:.2f} | |")
    rows.append(f"| bound of a gradient | {bound:.2f} | 1.00 |")
    softBD, N = SoftTerms(True, outlier=1e-10), SoftTerms(True, True, outlier=1e-10)
    for name, terms, temperature in (("softBD", softBD, NEAR), ("softBD, far", softBD, FAR), ("N", N, NEAR)):
        P, Q = (cloud[None] for cloud in clouds(1000))
        lengths = torch.tensor([temperature], dtype=torch.float64), torch.tensor([0.01], dtype=torch.float64)
        scene = Scene(CloudPair(P, Q, P, Q), *lengths)
        direction = Direction(torch.ones_like(Q), torch.ones_like(Q), torch.zeros(1, dtype=torch.float64))
        tables, loss = cpu.pack(terms, scene, direction).item(0), cpu.loss_of(terms)
        for what, sweeps in (("gradient", GRADIENT), ("directional derivative", DUAL)):
            kept = room_to_keep(sweeps, tables)
            spent = best(partial(sweeps.whole, tables, kept, loss), 5) / 1e6 * 1e9
            rows.append(f"| {name}, {what} | {spent:.2f} | {spent / bound:.2f} |")
    return rows
