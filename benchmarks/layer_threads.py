"""What a second thread brings, and a training batch: the layer, and the sweeps alone."""

import math
import multiprocessing
import threading
import time
from collections.abc import Callable

import numba
import torch

from bbr_layer import Adam, BBRLayer, Replay
from bbr_layer.kernels import cpu
from bbr_layer.kernels.cpu_batch import GRADIENT, Kept, room_to_keep
from bbr_layer.kernels.scene import Scene, SoftTerms
from bbr_layer.pair import CloudPair
from bbr_layer.threads import side_by_side
from benchmarks.layer_problems import clouds
from benchmarks.layer_sweeps import NEAR, best

THREADS_NOTE = (
    "A batch of 8 pairs of so many points, softBD, 30 steps, the best mean of three in a row. First the layer, forward "
    "and backward; then its gradient sweeps alone, 30 for each pair, nothing shared: as a step calls them, which keep "
    "8 bytes for each two points from the first sweep for the next two, and keeping nothing. Two processes: what the "
    "machine itself gives, each with a batch of its own."
)
LONG = 3  # calls in a row, so that a virtual machine has time to give a second thread a core of its own
BATCH, STEPS, SIZES = 8, 30, (512, 1000)


def thread_rows() -> list[str]:
    """The same work on one thread and on two, of the layer also in two processes."""
    rows = ["| what | points | one thread, s | two threads, s | speed-up | two processes, speed-up |", "|---" * 6 + "|"]
    for points in SIZES:
        one, two = _spent(_registration(BATCH, points, STEPS))
        with multiprocessing.get_context("spawn").Pool(2) as pool:
            beside = max(pool.map(_alone, [points] * 2, chunksize=1))
        rows.append(_row("the layer", points, (one, two), f"{2 * one / beside:.2f}"))
    for kept in (True, False):
        for points in SIZES:
            what = "gradient sweeps" if kept else "gradient sweeps, nothing kept"
            rows.append(_row(what, points, _spent(_sweeps(points, kept)), ""))
    return rows


def _row(what: str, points: int, spent: tuple[float, float], processes: str) -> str:
    one, two = spent
    return f"| {what} | {points} | {one:.3f} | {two:.3f} | {one / two:.2f} | {processes} |"


def _spent(run: Callable[[], object]) -> tuple[float, float]:
    """Seconds on one thread and on two, turn and turn about."""
    spent = {1: math.inf, 2: math.inf}
    for threads in (1, 2, 1, 2):
        torch.set_num_threads(threads)
        spent[threads] = min(spent[threads], best(run, LONG))
    return spent[1], spent[2]


def _sweeps(points: int, kept: bool) -> Callable[[], object]:
    P, Q = clouds(points, BATCH)
    terms = SoftTerms(True, outlier=1e-10)
    lengths = (torch.full((BATCH,), length, dtype=torch.float64) for length in (NEAR, 0.01))
    packed, loss, rooms = cpu.pack(terms, Scene(CloudPair(P, Q), *lengths)), cpu.loss_of(terms), threading.local()

    def work(b: int) -> None:
        tables = packed.item(b)
        if not hasattr(rooms, "room"):
            rooms.room = room_to_keep(GRADIENT, tables) if kept else None
        room: Kept = rooms.room
        for _ in range(STEPS):
            GRADIENT.whole(tables, room, loss)

    return lambda: side_by_side(work, BATCH)


def _registration(batch: int, points: int, steps: int) -> Callable[[], object]:
    P, Q = (cloud.requires_grad_() for cloud in clouds(points, batch))
    layer = BBRLayer("softBD", inner=Adam(steps, 0.05), backward=Replay())
    return lambda: torch.autograd.grad(layer(P, Q).target_from_source.matrix.square().sum(), (P, Q))


def _alone(points: int) -> float:
    """Seconds of the same batch in a process of its own, long enough for another one to run beside it."""
    torch.set_num_threads(1)
    run = _registration(BATCH, points, STEPS)
    return sorted(best(run, LONG) for _ in range(3))[1]


def batch_rows() -> list[str]:
    """Pairs per second, forward and backward, on all threads."""
    rows = ["| device | threads | seconds | pairs per second |", "|---|---|---|---|"]
    torch.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    run = _registration(64, 512, 100)
    begin = time.perf_counter()
    run()
    spent = time.perf_counter() - begin
    rows.append(f"| CPU | {torch.get_num_threads()} | {spent:.2f} | {64 / spent:.1f} |")
    if torch.cuda.is_available():
        P, Q = (cloud.cuda().requires_grad_() for cloud in clouds(512, 64))
        layer = BBRLayer("softBD", inner=Adam(100, 0.05))
        for _ in range(2):  # the first run compiles
            torch.cuda.synchronize()
            begin = time.perf_counter()
            torch.autograd.grad(layer(P, Q).target_from_source.matrix.square().sum(), (P, Q))
            torch.cuda.synchronize()
            spent = time.perf_counter() - begin
        rows.append(f"| {torch.cuda.get_device_name()} | | {spent:.2f} | {64 / spent:.1f} |")
    else:
        rows.append("| GPU | | none here | |")
    return rows
