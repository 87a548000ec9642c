"""What the compiled sweeps compute for one pair of points: distances, their rates of change, and slopes of the loss."""

from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_limits import clipped, if_free
from bbr_layer.kernels.cpu_math import ONE, TWO, ZERO, exp_negative, share_of


@compiled(forceinline=True)
def three(array, channel, first, last):  # type: ignore[no-untyped-def]
    """Columns ``first`` to ``last`` of three channels, as plain slices."""
    return array[channel, first:last], array[channel + 1, first:last], array[channel + 2, first:last]


@compiled(forceinline=True)
def add_three(array, channel, i, vector):  # type: ignore[no-untyped-def]
    """Add a vector to three channels of row ``i``."""
    array[channel, i] += vector[0]
    array[channel + 1, i] += vector[1]
    array[channel + 2, i] += vector[2]


@compiled(forceinline=True)
def add_at(slices, j, vector):  # type: ignore[no-untyped-def]
    """Add a vector to entry ``j`` of three slices."""
    slices[0][j] += vector[0]
    slices[1][j] += vector[1]
    slices[2][j] += vector[2]


@compiled(forceinline=True)
def add_up(total, part):  # type: ignore[no-untyped-def]
    """Add ``part`` to the first channels of ``total``, which may be more precise."""
    for k in range(part.shape[0]):
        for j in range(part.shape[1]):
            total[k, j] += part[k, j]


def kept_row(kept: Any, i: int, first: int, last: int) -> Any:
    """What was kept for row ``i`` from column ``first`` to ``last``, as plain slices; None if nothing was."""
    return None if kept is None else tuple(table[i, first:last] for table in kept)


@overload(kept_row, inline="always")
def _kept_row(kept, i, first, last):  # type: ignore[no-untyped-def]
    # Chosen by type: what is sometimes None and sometimes not has no compiled type.
    if kept == types.none:
        return lambda kept, i, first, last: None
    if len(kept) == 1:
        return lambda kept, i, first, last: (kept[0][i, first:last],)
    if len(kept) == 2:
        return lambda kept, i, first, last: (kept[0][i, first:last], kept[1][i, first:last])
    return lambda kept, i, first, last: (kept[0][i, first:last], kept[1][i, first:last], kept[2][i, first:last])


@compiled(forceinline=True)
def dot(a, b):  # type: ignore[no-untyped-def]
    """Inner product of two vectors of space."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled(forceinline=True)
def scaled(vector, factor):  # type: ignore[no-untyped-def]
    """A vector of space times a number."""
    return vector[0] * factor, vector[1] * factor, vector[2] * factor


@compiled(forceinline=True)
def plus(a, b):  # type: ignore[no-untyped-def]
    """The sum of two vectors of space."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@compiled(forceinline=True)
def inverse_of(root):  # type: ignore[no-untyped-def]
    """One over a length; 0 at 0."""
    return ONE / root if root > ZERO else ZERO


@compiled(forceinline=True)
def length(squared, smooth):  # type: ignore[no-untyped-def]
    """Root of a square, rounded off, and its inverse; 0 and 0 at 0."""
    root = np.sqrt(squared + smooth)
    return root, inverse_of(root)


@compiled(forceinline=True)
def measured(seen, j, squared, scales):  # type: ignore[no-untyped-def]
    """exp(-D / alpha), the distance and its inverse: of ``squared``, or as ``seen`` has them for column ``j``.

    ``scales`` are (smoothing squared, 1 / alpha).
    """
    if seen is None:
        distance, over = length(squared, scales[0])
        return exp_negative(-distance * scales[1]), distance, over
    return seen[0][j], seen[1][j], inverse_of(seen[1][j])


@compiled(forceinline=True)
def measured_rate(seen, j, squared, half_rate, scales):  # type: ignore[no-untyped-def]
    """The same, and the distance's rate; ``half_rate`` is half the rate of ``squared``."""
    if seen is None:
        distance, over = length(squared, scales[0])
        return exp_negative(-distance * scales[1]), distance, over, half_rate * over
    return seen[0][j], seen[1][j], inverse_of(seen[1][j]), seen[2][j]


@compiled(forceinline=True)
def plane(offset, row_normal, column_normal, align):  # type: ignore[no-untyped-def]
    """Sign of the row's normal, the sum of the two normals (Eq. 7), and the residual along it."""
    sign = -ONE if align * dot(row_normal, column_normal) < ZERO else ONE
    total = (
        column_normal[0] + sign * row_normal[0],
        column_normal[1] + sign * row_normal[1],
        column_normal[2] + sign * row_normal[2],
    )
    return sign, total, dot(offset, total)


@compiled(forceinline=True)
def point_of(rows, i):  # type: ignore[no-untyped-def]
    """The first three channels of row ``i``."""
    return rows[0, i], rows[1, i], rows[2, i]


@compiled(forceinline=True)
def plane_square(offset, normals, align, limit):  # type: ignore[no-untyped-def]
    """The square of Eq. 7's distance; ``normals`` are (row's, column's)."""
    _, _, residual = plane(offset, normals[0], normals[1], align)
    return clipped(residual * residual, limit)


@compiled(forceinline=True)
def plane_square_rate(motion, normals, align, limit):  # type: ignore[no-untyped-def]
    """The same and half its rate; ``motion`` is (offset, velocity), ``normals`` (row's, column's, its velocity)."""
    _, total, residual = plane(motion[0], normals[0], normals[1], align)
    squared, half_rate = residual * residual, residual * (dot(motion[1], total) + dot(motion[0], normals[2]))
    return clipped(squared, limit), if_free(half_rate, squared, limit)


@compiled(forceinline=True)
def slope_parts(e, distance, row, column, loss):  # type: ignore[no-untyped-def]
    """Derivatives of the loss by the logit u of this pair, and by its distance while its buddies are held.

    ``row`` and ``column`` are (weight, inverse denominator, share), ``loss`` is (1 / alpha, by S, by M).
    """
    r, c = share_of(e, row[1]), share_of(e, column[1])
    buddies = row[0] * column[0] * r * c
    by_logit = TWO * (loss[1] + loss[2] * distance) * buddies - r * row[2] - c * column[2]
    return by_logit, loss[2] * buddies


@compiled(forceinline=True)
def slope(e, distance, row, column, loss):  # type: ignore[no-untyped-def]
    """The same where u = -D / alpha: by the logit, and by the distance through both."""
    by_logit, held = slope_parts(e, distance, row, column, loss)
    return by_logit, held - by_logit * loss[0]


@compiled(forceinline=True)
def logit_rate(distance, distance_rate, cool, cool_rate):  # type: ignore[no-untyped-def]
    """Rate of change of -D / alpha; ``cool_rate`` is that of alpha over alpha."""
    return cool * (distance * cool_rate - distance_rate)


@compiled(forceinline=True)
def slope_part_rates(at, rates, row, column, loss):  # type: ignore[no-untyped-def]
    """Rates of change of what ``slope_parts`` answers, after the two themselves.

    ``at`` is (e, distance), ``rates`` (of the logit, of the distance). ``row`` and ``column`` go on with the rates of
    change of the denominator (relative) and of the share; ``loss`` with those of alpha (relative), by S and by M.
    """
    (e, distance), (rate, distance_rate) = at, rates
    r, c = share_of(e, row[1]), share_of(e, column[1])
    buddies = row[0] * column[0] * r * c
    r_rate, c_rate = rate - row[3], rate - column[3]
    buddies_rate = buddies * (r_rate + c_rate)
    value = loss[1] + loss[2] * distance
    value_rate = loss[4] + loss[5] * distance + loss[2] * distance_rate
    by_logit = TWO * value * buddies - r * row[2] - c * column[2]
    by_logit_rate = TWO * (value_rate * buddies + value * buddies_rate)
    by_logit_rate -= r * (r_rate * row[2] + row[4]) + c * (c_rate * column[2] + column[4])
    return by_logit, loss[2] * buddies, by_logit_rate, loss[5] * buddies + loss[2] * buddies_rate


@compiled(forceinline=True)
def slope_rate(at, rates, row, column, loss):  # type: ignore[no-untyped-def]
    """Rates of change of what ``slope`` answers, after the two themselves; arguments as for their parts."""
    by_logit, held, by_logit_rate, held_rate = slope_part_rates(at, rates, row, column, loss)
    by_distance_rate = held_rate - (by_logit_rate - by_logit * loss[3]) * loss[0]
    return by_logit, held - by_logit * loss[0], by_logit_rate, by_distance_rate
