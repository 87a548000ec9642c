"""The layer's speed, memory and gradients beside what a user would otherwise do.

    python -m benchmarks.layer --out benchmarks/layer.md

Every cell of the first table runs in a process of its own, on one thread, in float32: the best of three after runs on
50 points that compile, and the growth of the process's peak memory over what it held before. Rivals: the plain
differentiable unroll (``Autograd()``), the same with every step checkpointed, and TorchOpt's
MetaAdam (``pip install torchopt``).
"""

import argparse
import importlib.util
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer import Adam, Autograd, BBRLayer, Implicit, Replay
from bbr_layer.kernels import cpu_batch
from benchmarks import layer_gradients, layer_rivals, layer_sweeps, layer_threads
from benchmarks.layer_problems import CHANNELS, clouds, features
from benchmarks.memory import forget_peak, peak

STEPS, RATE = 30, 0.05
BY_FEATURES = f", {CHANNELS} features"
LOSSES = ("softBD", "softBBS", "N", f"softBD{BY_FEATURES}")
# Points of the runs that compile, and pairs per part in them: one part and several, which are compiled apart.
WARM_POINTS, WARM_PARTS = 50, (2500, 500)


class Cell(NamedTuple):
    """Seconds forward, seconds forward and backward, MiB above the inputs."""

    forward: float
    both: float
    memory: float


def layer(name: str, mode: object, steps: int = STEPS) -> Callable[[Tensor, Tensor], Tensor]:
    """The layer as a function of two clouds that answers its matrix; features, where named, get a gradient too."""
    chosen = BBRLayer(name.removesuffix(BY_FEATURES), inner=Adam(steps, RATE), backward=mode)
    beside = features if name.endswith(BY_FEATURES) else lambda n: {}
    return lambda P, Q: chosen(P, Q, **beside(len(P))).target_from_source.matrix


def contestants(name: str, steps: int) -> dict[str, Callable[[], Callable[[Tensor, Tensor], Tensor]]]:
    """Who is measured, by name; each is built in the process that measures it."""
    by_hand = {
        "checkpoint per step": lambda: layer_rivals.checkpointed(name, steps, RATE),
        "TorchOpt MetaAdam": lambda: layer_rivals.torchopt_unroll(name, steps, RATE),
    }
    return {
        "plain unroll": lambda: layer(name, Autograd(), steps),
        **({} if name.endswith(BY_FEATURES) else by_hand),
        "Replay, torch sweeps": lambda: layer(name, Replay(), steps),
        "Replay, compiled sweeps": lambda: layer(name, Replay(), steps),
        "Implicit, compiled sweeps": lambda: layer(name, Implicit(on_unconverged="warn"), steps),
    }


def measured(name: str, who: str, n: int, steps: int) -> Cell:
    """One cell, in this process."""
    torch.set_num_threads(1)
    if who == "Replay, torch sweeps":
        os.environ["BBR_BACKEND"] = "torch"
    register = contestants(name, steps)[who]()
    P, Q = (x.requires_grad_() for x in clouds(n))
    warm_up(register, P, Q)
    held = forget_peak()
    times = []
    for _ in range(1 if who in ("plain unroll", "TorchOpt MetaAdam") and n > 500 else 3):
        begin = time.perf_counter()
        matrix = register(P, Q)
        middle = time.perf_counter()
        torch.autograd.grad(matrix.square().sum(), (P, Q))
        times.append((middle - begin, time.perf_counter() - begin))
    return Cell(min(t[0] for t in times), min(t[1] for t in times), peak() - held)


def warm_up(register: Callable[[Tensor, Tensor], Tensor], P: Tensor, Q: Tensor) -> None:
    """Compile, and load what is loaded once, on few points: what they leave in the heap is little."""
    usual = cpu_batch.PAIRS_PER_PART
    for pairs in WARM_PARTS:
        cpu_batch.PAIRS_PER_PART = pairs
        warm = [x.detach()[:WARM_POINTS].clone().requires_grad_() for x in (P, Q)]
        torch.autograd.grad(register(*warm).square().sum(), warm)
    cpu_batch.PAIRS_PER_PART = usual


def in_own_process(function: Callable, *arguments: object) -> object:
    """The answer of ``function``, computed in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def speed_rows(sizes: list[int], losses: list[str]) -> list[str]:
    """The table of speed and memory; ratios to the plain unroll of the same row group."""
    rows = [
        "| loss | n = m | method | forward, ratio | forward + backward, ratio | seconds | MiB |",
        "|---|---|---|---|---|---|---|",
    ]
    for n in sizes:
        for name in losses:
            plain: Cell | None = None
            for who in contestants(name, STEPS):
                if who.startswith("TorchOpt") and importlib.util.find_spec("torchopt") is None:
                    continue
                cell = in_own_process(measured, name, who, n, STEPS)
                assert isinstance(cell, Cell)
                plain = plain or cell
                ratios = f"{cell.forward / plain.forward:.3f} | {cell.both / plain.both:.3f}"
                rows.append(f"| {name} | {n} | {who} | {ratios} | {cell.both:.3f} | {cell.memory:.1f} |")
                print(rows[-1], flush=True)
    return rows


def memory_rows() -> list[str]:
    """Memory against the number of steps."""
    rows = ["| steps | MiB above the inputs, softBD, n = m = 1000, Replay |", "|---|---|"]
    for steps in (30, 300):
        cell = in_own_process(measured, "softBD", "Replay, compiled sweeps", 1000, steps)
        assert isinstance(cell, Cell)
        rows.append(f"| {steps} | {cell.memory:.1f} |")
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    """Write all tables to the file named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 1000])
    parser.add_argument("--losses", nargs="+", default=list(LOSSES))
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    tables = [
        ("Speed and memory", f"T = {STEPS}, one thread, float32.", lambda: speed_rows(options.sizes, options.losses)),
        ("Memory against steps", "", memory_rows),
        ("The sweeps", layer_sweeps.PRIMITIVES_NOTE, layer_sweeps.sweep_rows),
        ("Threads", layer_threads.THREADS_NOTE, layer_threads.thread_rows),
        ("A training batch", "64 pairs of 512 points, softBD, 100 steps, float32.", layer_threads.batch_rows),
        ("Gradients", layer_gradients.NOTE, layer_gradients.error_rows),
    ]
    command = f"python -m benchmarks.layer {' '.join(sys.argv[1:])}"
    lines = [f"Made by `{command}` on {cpu_name()} ({os.cpu_count()} cores), torch {torch.__version__}.", ""]
    for title, note, rows in tables:
        print(title, flush=True)
        lines += [f"## {title}", "", *([note, ""] if note else []), *rows(), ""]
        options.out.write_text("\n".join(lines).rstrip() + "\n", encoding="utf-8")


def cpu_name() -> str:
    """The processor as the system names it, with what vectors it has."""
    text = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    model = next((line.split(":")[1].strip() for line in text.splitlines() if line.startswith("model name")), "a CPU")
    return f"{model}, {'AVX-512' if 'avx512f' in text else 'AVX2' if 'avx2' in text else 'no AVX2'}"


if __name__ == "__main__":
    main()
