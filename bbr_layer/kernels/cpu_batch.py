"""The compiled sweeps over a batch: one item after the other or side by side, the rows of a large one in parts.

How the work is cut depends on the shapes alone, and parts are added up in order: the answer does not depend on the
number of threads.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_apart import Apart, Features, Pulled
from bbr_layer.kernels.cpu_clipping import settle_limit
from bbr_layer.kernels.cpu_items import (
    Beside,
    Both,
    Loss,
    Normals,
    Tables,
    item_gradient,
    item_rates,
    settle_buddies,
    settle_denominators,
)
from bbr_layer.kernels.cpu_kinds import DUAL_SWEEPS, GRADIENT_SWEEPS
from bbr_layer.kernels.cpu_math import COLUMN_OUT, KEPT_PAIRS, ROW_OUT
from bbr_layer.threads import side_by_side

# A single item is cut into at most this many parts, of at least this many pairs each.
MOST_PARTS, PAIRS_PER_PART = 8, 2**17

Kept = tuple[np.ndarray, ...] | None


class Sweeps(NamedTuple):
    """The three sweeps, the three of one item in one call, and whether rates are asked for.

    Parameters
    ----------
    kept: how many numbers of a pair are kept from the first sweep for the others, for points, for planes and where
        buddies are found by features.
    """

    parts: tuple[Callable, Callable, Callable]
    whole: Callable
    rates: bool
    kept: tuple[int, int, int]


GRADIENT = Sweeps(GRADIENT_SWEEPS, item_gradient, False, (2, 2, 2))
# For planes, loading what was kept is no faster than computing it again (measured at 500 and 1000 points).
DUAL = Sweeps(DUAL_SWEEPS, item_rates, True, (3, 0, 2))


class Packed(NamedTuple):
    """A batch of ``Tables``: the same fields with the batch before them; normals, features or neither."""

    sides: Both
    normals: Normals
    features: Features | None
    sums: Both
    shares: Both
    constants: np.ndarray

    def item(self, b: int, pulled: bool = True) -> Tables:
        """Item ``b``; ``pulled`` where somebody asks for the derivative by its features."""
        sides, sums, shares = ((x[0][b], x[1][b]) for x in (self.sides, self.sums, self.shares))
        beside: Beside = None if self.normals is None else tuple(x[b] for x in self.normals)
        if self.features is not None:
            beside = self.features.pulled(b) if pulled else self.features.apart(b)
        return Tables(sides, beside, sums, shares, self.constants[b])

    def settle(self, b: int, tables: Tables) -> None:
        """Take what was pulled of item ``b`` back to its features."""
        if self.features is not None and isinstance(tables.beside, Pulled):
            self.features.take_back(b, tables.beside.pull)


def room_for_sums(batch: int, n: int, m: int) -> tuple[Both, Both]:
    """Zeros for sums and for shares."""
    sums = np.zeros((batch, 2 * ROW_OUT, n)), np.zeros((batch, 2 * COLUMN_OUT, m))
    return sums, (np.zeros((batch, 2, n)), np.zeros((batch, 2, m)))


def room_to_keep(sweeps: Sweeps, tables: Tables) -> Kept:
    """What the first sweep of an item may keep for the others; None where that is nothing, or would be too much."""
    rows, columns = tables.sides
    by_features = isinstance(tables.beside, Apart | Pulled)
    count = sweeps.kept[2 if by_features else int(tables.beside is not None)]
    if not count or rows.shape[1] * columns.shape[1] > KEPT_PAIRS:
        return None
    return tuple(np.empty((rows.shape[1], columns.shape[1]), rows.dtype) for _ in range(count))


def parts_of(batch: int, n: int, m: int) -> int:
    """Into how many parts the rows of an item are cut."""
    return max(1, min(MOST_PARTS, n * m // PAIRS_PER_PART)) if batch == 1 else 1


def run_sweeps(sweeps: Sweeps, packed: Packed, loss: Loss) -> np.ndarray:
    """Losses of all items, ``(batch,)``; their gradients and, if asked, rates are left in ``packed``.

    Nothing is kept between the sweeps: for a single call, fresh memory costs more than it saves.
    """
    losses = np.zeros(len(packed.constants))

    def work(b: int) -> None:
        tables = packed.item(b)
        losses[b] = run_item(sweeps, tables, None, loss, len(losses))
        packed.settle(b, tables)

    side_by_side(work, len(losses))
    return losses


def run_item(sweeps: Sweeps, tables: Tables, kept: Kept, loss: Loss, batch: int) -> float:
    """The loss of one item of a batch of so many; what else is found is left in the tables."""
    n, m = (side.shape[1] for side in tables.sides)
    parts = parts_of(batch, n, m)
    if parts == 1:
        return sweeps.whole(tables, kept, loss)
    settle_limit(tables.sides, tables.beside, tables.constants, loss.clip)
    spans = [slice(n * number // parts, n * (number + 1) // parts) for number in range(parts)]
    _in_parts(sweeps.parts[0], tables, kept, spans)
    settle_denominators(tables, loss, sweeps.rates)
    _in_parts(sweeps.parts[1], tables, kept, spans)
    value = settle_buddies(tables, loss, sweeps.rates)
    _in_parts(sweeps.parts[2], tables, kept, spans)
    return value


def _in_parts(sweep: Callable, tables: Tables, kept: Kept, spans: list[slice]) -> None:
    row_sums, column_sums = tables.sums
    row_sums[:] = 0
    partial_sums = np.zeros((len(spans), *column_sums.shape))
    side_by_side(partial(_part, sweep, tables, kept, (spans, partial_sums)), len(spans))
    column_sums[:] = partial_sums.sum(0)


def _part(sweep: Callable, tables: Tables, kept: Kept, cut: tuple[list[slice], np.ndarray], number: int) -> None:
    (rows, columns), span = tables.sides, cut[0][number]
    out = tables.sums[0][:, span], cut[1][number]
    own = None if kept is None else tuple(table[span] for table in kept)
    sweep((rows[:, span], columns), _beside_rows(tables.beside, span), out, tables.constants, own)


def _beside_rows(beside: Beside, span: slice) -> Beside:
    """What stands beside some of the rows."""
    if isinstance(beside, Apart | Pulled):
        return type(beside)(*(table[span] for table in beside))
    return None if beside is None else (beside[0][:, span], *beside[1:])
