"""The compiled sweeps over a batch: one item after the other or side by side, the rows of a large one in parts.

The sweeps let go of Python's lock, so that plain threads run them. How the work is cut depends on the shapes alone,
and parts are added up in order: the answer does not depend on the number of threads.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from bbr_layer.kernels.cpu_dual import buddy_sum_rates, denominator_rates
from bbr_layer.kernels.cpu_dual_forces import point_force_rates
from bbr_layer.kernels.cpu_dual_planes import plane_force_rates
from bbr_layer.kernels.cpu_items import invert, settle_loss, settle_shares
from bbr_layer.kernels.cpu_math import COLUMN_OUT, ROW_OUT
from bbr_layer.kernels.cpu_sweeps import buddy_sums, denominators, plane_forces, point_forces

# A single item is cut into at most this many parts, of at least this many pairs each.
MOST_PARTS, PAIRS_PER_PART = 8, 2**17


class Sweeps(NamedTuple):
    """The three sweeps for point-to-point and for point-to-plane distances, and how many channels they fill."""

    points: tuple[Callable, Callable, Callable]
    planes: tuple[Callable, Callable, Callable]
    orders: int  # 1: values; 2: values and their rates


GRADIENT = Sweeps((denominators, buddy_sums, point_forces), (denominators, buddy_sums, plane_forces), 1)
DUAL = Sweeps(
    (denominator_rates, buddy_sum_rates, point_force_rates),
    (denominator_rates, buddy_sum_rates, plane_force_rates),
    2,
)


class Packed(NamedTuple):
    """A batch as the sweeps read it; see ``cpu_math`` for channels and constants.

    Parameters
    ----------
    rows, columns: ``(b, channels, n)`` and ``(b, channels, m)``.
    row_normals, column_normals: ``(b, 3, n)`` and ``(b, 6, m)``, or None.
    constants: ``(b, c)``.
    """

    rows: np.ndarray
    columns: np.ndarray
    row_normals: np.ndarray | None
    column_normals: np.ndarray | None
    constants: np.ndarray


class Sums(NamedTuple):
    """What the sweeps answer, float64: values, and behind them their rates if they were asked for.

    Parameters
    ----------
    losses: ``(b,)``.
    rows, columns: ``(b, 8 or 16, n)`` and ``(b, 6 or 12, m)``, as ``point_forces`` and its kin fill them.
    row_shares, column_shares: ``(b, 1 or 2, n)`` and ``(b, 1 or 2, m)``: the loss per unit of weight of each point.
    """

    losses: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    row_shares: np.ndarray
    column_shares: np.ndarray


def run_sweeps(sweeps: Sweeps, packed: Packed, outlier: float, mean: bool) -> Sums:
    """Loss and gradient of every item; inverse denominators and shares are left in ``packed``."""
    (batch, _, n), m, orders = packed.rows.shape, packed.columns.shape[2], sweeps.orders
    sums = Sums(
        np.zeros(batch),
        np.zeros((batch, ROW_OUT * orders, n)),
        np.zeros((batch, COLUMN_OUT * orders, m)),
        np.zeros((batch, orders, n)),
        np.zeros((batch, orders, m)),
    )
    parts = max(1, min(MOST_PARTS, n * m // PAIRS_PER_PART)) if batch == 1 else 1

    side_by_side(partial(_item, sweeps, packed, sums, (parts, outlier, mean)), batch)
    return sums


def _item(sweeps: Sweeps, packed: Packed, sums: Sums, settings: tuple[int, float, bool], b: int) -> None:
    """All three sweeps over item ``b``; ``settings`` are the parts, the epsilon, and whether the loss is a mean."""
    rows, columns, constants, rates = packed.rows[b], packed.columns[b], packed.constants[b], sweeps.orders > 1
    parts, outlier, mean = settings
    _sweep(sweeps, 0, packed, (b, parts), sums)
    invert(rows, sums.rows[b], outlier, rates)
    invert(columns, sums.columns[b], outlier, rates)
    _sweep(sweeps, 1, packed, (b, parts), sums)
    sums.losses[b] = settle_loss(rows, sums.rows[b], constants, mean, rates)
    settle_shares(rows, sums.rows[b], constants, sums.row_shares[b], rates)
    settle_shares(columns, sums.columns[b], constants, sums.column_shares[b], rates)
    _sweep(sweeps, 2, packed, (b, parts), sums)


def _sweep(sweeps: Sweeps, which: int, packed: Packed, cut: tuple[int, int], sums: Sums) -> None:
    """Sweep ``which`` over item ``cut[0]`` in ``cut[1]`` parts of its rows."""
    (b, parts), n = cut, packed.rows.shape[2]
    row_out, column_out = sums.rows[b], sums.columns[b]
    row_out[:], column_out[:] = 0, 0
    partial_sums = column_out[None] if parts == 1 else np.zeros((parts, *column_out.shape))
    spans = [slice(n * number // parts, n * (number + 1) // parts) for number in range(parts)]
    tables = row_out, partial_sums, spans
    if parts == 1:
        _part(sweeps, (which, b), packed, tables, 0)
    else:
        side_by_side(partial(_part, sweeps, (which, b), packed, tables), parts)
        column_out += partial_sums.sum(0)


def _part(
    sweeps: Sweeps,
    which: tuple[int, int],
    packed: Packed,
    tables: tuple[np.ndarray, np.ndarray, list[slice]],
    number: int,
) -> None:
    """Part ``number`` of sweep ``which[0]`` over item ``which[1]``."""
    (sweep, b), (row_out, partial_sums, spans) = which, tables
    span, columns, out = spans[number], packed.columns[b], (row_out[:, spans[number]], partial_sums[number])
    if packed.row_normals is None or packed.column_normals is None:
        sweeps.points[sweep](packed.rows[b][:, span], columns, None, out, packed.constants[b])
    else:
        normals = packed.row_normals[b][:, span], packed.column_normals[b]
        sweeps.planes[sweep](packed.rows[b][:, span], columns, normals, out, packed.constants[b])


def side_by_side(work: Callable[[int], None], count: int) -> None:
    """``work(0)`` to ``work(count - 1)`` on as many threads as torch is set to."""
    threads = min(torch.get_num_threads(), count)
    if threads == 1:
        for number in range(count):
            work(number)
    else:
        for done in _pool(threads).map(work, range(count)):
            assert done is None


_POOLS: dict[int, ThreadPoolExecutor] = {}


def _pool(threads: int) -> ThreadPoolExecutor:
    return _POOLS.setdefault(threads, ThreadPoolExecutor(threads, thread_name_prefix="bbr_layer"))


# A forked process (a worker of a data loader) has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_POOLS.clear)
