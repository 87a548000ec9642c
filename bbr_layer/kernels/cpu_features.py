"""The sweeps of the gradient where buddies are found by features; as ``cpu_sweeps.py`` and ``cpu_forces.py`` otherwise.

In the place of normals they take ``Apart`` or ``Pulled``. Buddies are those of ``sqrt(space D^2 + features^2)``, with
``constants[SPACE]`` 1 where coordinates count beside features and 0 where features alone do; what the loss means or
sums is the distance D in space. The first sweep keeps exponentials and the former distances for the others.
"""

import inspect
from typing import Any

import numpy as np
from numba.extending import overload

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_math import (
    BY_M,
    BY_S,
    CHUNK,
    COOL,
    HEAT,
    INVERSE,
    ROUND,
    SHARE,
    SMOOTH,
    SPACE,
    TILE,
    WEIGHT,
    ZERO,
    exp_negative,
    share_of,
    wide_vectors,
)
from bbr_layer.kernels.cpu_pairs import (
    add_at,
    add_three,
    add_up,
    dot,
    inverse_of,
    kept_row,
    length,
    point_of,
    scaled,
    slope_parts,
    three,
)


@compiled(forceinline=True)
def likened(seen, j, squared, apart, scales):  # type: ignore[no-untyped-def]
    """The exponential of a pair and the distance that it is of, computed or as ``seen`` has them for column ``j``.

    ``scales`` are (smoothing squared, 1 / alpha, 1 where coordinates count).
    """
    if seen is None:
        matched = length(scales[2] * squared + apart, scales[0])[0]
        return exp_negative(-matched * scales[1]), matched
    return seen[0][j], seen[1][j]


def add_pull(beside: Any, j: int, value: float) -> None:
    """Add to what is pulled in column ``j``; nothing where nobody asks for it. ``beside`` are slices of a row."""
    if len(beside) == 2:
        beside[1][j] += value


@overload(add_pull, inline="always")
def _add_pull(beside, j, value):  # type: ignore[no-untyped-def]
    if len(beside) == 1:
        return lambda beside, j, value: None

    def add(beside, j, value):  # type: ignore[no-untyped-def]
        beside[1][j] += value

    return inspect.unwrap(add)


@compiled()
def feature_denominators(sides, features, out, constants, kept):  # type: ignore[no-untyped-def]
    """As ``denominators``."""
    wide_vectors()
    rows, columns = sides
    scales = constants[SMOOTH], constants[COOL], constants[SPACE]
    sums = np.empty((1, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            qx, qy, qz = three(columns, 0, first, last)
            total = sums[0, first:last]
            for i in range(low, high):
                px, py, pz = point_of(rows, i)
                row, beside = px * ZERO, kept_row(features, i, first, last)
                seen = kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    e, matched = likened(None, j, dot(offset, offset), beside[0][j], scales)
                    if kept is not None:
                        seen[0][j], seen[1][j] = e, matched
                    row += e
                    total[j] += e
                out[0][0, i] += row
        add_up(out[1], sums)


@compiled()
def feature_buddy_sums(sides, features, out, constants, kept):  # type: ignore[no-untyped-def]
    """As ``buddy_sums``."""
    wide_vectors()
    rows, columns = sides
    scales = constants[SMOOTH], constants[COOL], constants[SPACE]
    sums = np.empty((2, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            qx, qy, qz = three(columns, 0, first, last)
            weight, inverse = columns[WEIGHT, first:last], columns[INVERSE, first:last]
            count, lengths = sums[0, first:last], sums[1, first:last]
            for i in range(low, high):
                (px, py, pz), own, row_inverse = point_of(rows, i), rows[WEIGHT, i], rows[INVERSE, i]
                row_count = row_lengths = px * ZERO
                beside, seen = kept_row(features, i, first, last), kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    squared = dot(offset, offset)
                    e, _ = likened(seen, j, squared, beside[0][j], scales)
                    distance, _ = length(squared, scales[0])
                    buddies = share_of(e, row_inverse) * share_of(e, inverse[j])
                    row_count += buddies * weight[j]
                    row_lengths += buddies * weight[j] * distance
                    count[j] += buddies * own
                    lengths[j] += buddies * own * distance
                out[0][0, i] += row_count
                out[0][1, i] += row_lengths
        add_up(out[1], sums)


@compiled()
def feature_forces(sides, features, out, constants, kept):  # type: ignore[no-untyped-def]
    """As ``point_forces``; what each pair's features say is added to ``Pulled``."""
    wide_vectors()
    rows, columns = sides
    scales = constants[SMOOTH], constants[COOL], constants[SPACE]
    loss = constants[COOL], constants[BY_S], constants[BY_M]
    sums = np.empty((3, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), f = three(columns, 0, first, last), three(sums, 0, first, last)
            weight, inverse, share = three(columns, WEIGHT, first, last)
            for i in range(low, high):
                px, py, pz = point_of(rows, i)
                row = rows[WEIGHT, i], rows[INVERSE, i], rows[SHARE, i]
                gx = gy = gz = heat = rounding = px * ZERO
                beside, seen = kept_row(features, i, first, last), kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    squared = dot(offset, offset)
                    e, matched = likened(seen, j, squared, beside[0][j], scales)
                    distance, over = length(squared, scales[0])
                    by_logit, held = slope_parts(e, distance, row, (weight[j], inverse[j], share[j]), loss)
                    held, pull = held * over, -by_logit * loss[0] * inverse_of(matched)
                    add_pull(beside, j, pull)
                    heat += by_logit * matched
                    rounding += held + pull
                    x, y, z = scaled(offset, held + scales[2] * pull)
                    gx, gy, gz = gx - x, gy - y, gz - z
                    add_at(f, j, (x, y, z))
                add_three(out[0], 0, i, (gx, gy, gz))
                out[0][HEAT, i] += heat
                out[0][ROUND, i] += rounding
        add_up(out[1], sums)
