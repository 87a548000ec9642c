"""The compiled sweeps over one whole item, and what the sums between them say about its rows, columns and loss."""

from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_apart import Apart, Pulled
from bbr_layer.kernels.cpu_clipping import settle_limit
from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_kinds import DUAL_SWEEPS, GRADIENT_SWEEPS
from bbr_layer.kernels.cpu_math import (
    BY_M,
    BY_M_RATE,
    BY_S,
    BY_S_RATE,
    INVERSE,
    INVERSE_RATE,
    SHARE,
    SHARE_RATE,
    WEIGHT,
)

Both = tuple[np.ndarray, np.ndarray]
Normals = tuple[np.ndarray, ...] | None
Beside = Normals | Apart | Pulled
# By name, as Numba knows them.
_denominators, _buddy_sums, _forces = GRADIENT_SWEEPS
_denominator_rates, _buddy_sum_rates, _force_rates = DUAL_SWEEPS


class Loss(NamedTuple):
    """The epsilon of Eq. 4, whether the loss is M / S (Eq. 6) or -S (Eq. 5), and ``settle_limit``'s ``clip``."""

    outlier: float
    mean: bool
    clip: float


class Tables(NamedTuple):
    """One item as the sweeps read and fill it; ``Both`` are of the rows and of the columns.

    Parameters
    ----------
    sides: ``(channels, n)`` and ``(channels, m)``, see ``cpu_math``.
    beside: normals, ``(3, n)`` and ``(6, m)``, and the limit ``(1,)`` of a loss that clips; or how far features are
        apart; or None.
    sums: float64 ``(16, n)`` and ``(12, m)``, values before rates, as ``forces`` and its kin fill them.
    shares: float64 ``(2, n)`` and ``(2, m)``: the loss per unit of weight of each point, and its rate.
    constants: ``(c,)``.
    """

    sides: Both
    beside: Beside
    sums: Both
    shares: Both
    constants: np.ndarray


@compiled()
def invert(side, sums, outlier, rates):  # type: ignore[no-untyped-def]
    """Inverse denominators of Eq. 4 and, if asked, their relative rates, from sums ``(channels, points)``."""
    for i in range(side.shape[1]):
        total = sums[0, i] + outlier
        side[INVERSE, i] = 1 / total
        if rates:
            side[INVERSE_RATE, i] = sums[1, i] / total


@compiled()
def weighted_total(side, sums, channel):  # type: ignore[no-untyped-def]
    """The sum over all points of one channel times their weight."""
    total = 0.0
    for i in range(side.shape[1]):
        total += side[WEIGHT, i] * sums[channel, i]
    return total


@compiled()
def settle_loss(rows, sums, constants, mean, rates):  # type: ignore[no-untyped-def]
    """The loss from S and M; its derivatives by both, and their rates, go into the constants (``loss_of_sums``)."""
    S, M = weighted_total(rows, sums, 0), weighted_total(rows, sums, 1)
    constants[BY_S], constants[BY_M], constants[BY_S_RATE], constants[BY_M_RATE] = -1.0, 0.0, 0.0, 0.0
    if not mean:
        return -S
    if S <= 0:
        constants[BY_S] = 0.0
        return 0.0
    loss = M / S
    constants[BY_S], constants[BY_M] = -loss / S, 1 / S
    if rates:
        S_rate, M_rate = weighted_total(rows, sums, 2), weighted_total(rows, sums, 3)
        loss_rate = (M_rate - loss * S_rate) / S
        constants[BY_S_RATE] = (loss * S_rate / S - loss_rate) / S
        constants[BY_M_RATE] = -S_rate / (S * S)
    return loss


@compiled()
def settle_shares(side, sums, constants, shares, rates):  # type: ignore[no-untyped-def]
    """The loss per unit of weight of each point (and its rate) into ``shares``, times the weight into ``side``."""
    for i in range(side.shape[1]):
        share = constants[BY_S] * sums[0, i] + constants[BY_M] * sums[1, i]
        shares[0, i] = share
        side[SHARE, i] = share * side[WEIGHT, i]
        if rates:
            change = constants[BY_S_RATE] * sums[0, i] + constants[BY_S] * sums[2, i]
            change += constants[BY_M_RATE] * sums[1, i] + constants[BY_M] * sums[3, i]
            shares[1, i] = change
            side[SHARE_RATE, i] = change * side[WEIGHT, i]


@compiled()
def cleared(tables):  # type: ignore[no-untyped-def]
    """Two tables of sums, set to 0."""
    tables[0][:] = 0
    tables[1][:] = 0
    return tables


@compiled()
def settle_denominators(tables, loss, rates):  # type: ignore[no-untyped-def]
    """After the first sweep."""
    invert(tables.sides[0], tables.sums[0], loss.outlier, rates)
    invert(tables.sides[1], tables.sums[1], loss.outlier, rates)


@compiled()
def settle_buddies(tables, loss, rates):  # type: ignore[no-untyped-def]
    """After the second sweep: the loss."""
    sides, sums, shares, constants = tables.sides, tables.sums, tables.shares, tables.constants
    value = settle_loss(sides[0], sums[0], constants, loss.mean, rates)
    settle_shares(sides[0], sums[0], constants, shares[0], rates)
    settle_shares(sides[1], sums[1], constants, shares[1], rates)
    return value


@compiled()
def item_gradient(tables, kept, loss):  # type: ignore[no-untyped-def]
    """The loss of one item; its gradient is left in ``sums`` and ``shares``.

    ``kept`` is room for what the first sweep keeps, or None.
    """
    sides, beside, sums, constants = tables.sides, tables.beside, tables.sums, tables.constants
    settle_limit(sides, beside, constants, loss.clip)
    _denominators(sides, beside, cleared(sums), constants, kept)
    settle_denominators(tables, loss, False)
    _buddy_sums(sides, beside, cleared(sums), constants, kept)
    value = settle_buddies(tables, loss, False)
    _forces(sides, beside, cleared(sums), constants, kept)
    return value


@compiled()
def item_rates(tables, kept, loss):  # type: ignore[no-untyped-def]
    """The same and the rates of change of all of it."""
    sides, beside, sums, constants = tables.sides, tables.beside, tables.sums, tables.constants
    settle_limit(sides, beside, constants, loss.clip)
    _denominator_rates(sides, beside, cleared(sums), constants, kept)
    settle_denominators(tables, loss, True)
    _buddy_sum_rates(sides, beside, cleared(sums), constants, kept)
    value = settle_buddies(tables, loss, True)
    _force_rates(sides, beside, cleared(sums), constants, kept)
    return value
