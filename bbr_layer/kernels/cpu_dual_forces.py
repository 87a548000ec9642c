"""The last sweep in dual numbers: forces and their rates of change; arguments as in ``cpu_dual.py``.

What ``cpu_sweeps`` sums in channel c is here in c, and its rate ``ROW_OUT`` or ``COLUMN_OUT`` channels later.
"""

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_math import (
    BY_M,
    BY_M_RATE,
    BY_S,
    BY_S_RATE,
    CHUNK,
    COLUMN_OUT,
    COOL,
    COOL_RATE,
    HEAT,
    INVERSE,
    INVERSE_RATE,
    ROUND,
    ROW_OUT,
    SHARE,
    SHARE_RATE,
    SMOOTH,
    TILE,
    VELOCITY,
    WEIGHT,
    ZERO,
    wide_vectors,
)
from bbr_layer.kernels.cpu_pairs import (
    add_at,
    add_three,
    add_up,
    dot,
    kept_row,
    logit_rate,
    measured_rate,
    plus,
    point_of,
    scaled,
    slope_rate,
    three,
)


@compiled(forceinline=True)
def loss_rates(constants):  # type: ignore[no-untyped-def]
    """What ``slope_rate`` calls ``loss``."""
    values = constants[COOL], constants[BY_S], constants[BY_M]
    return values + (constants[COOL_RATE], constants[BY_S_RATE], constants[BY_M_RATE])


@compiled(forceinline=True)
def row_rates(rows, i):  # type: ignore[no-untyped-def]
    """What ``slope_rate`` calls ``row``."""
    return rows[WEIGHT, i], rows[INVERSE, i], rows[SHARE, i], rows[INVERSE_RATE, i], rows[SHARE_RATE, i]


@compiled()
def point_force_rates(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """``point_forces`` and their rates."""
    wide_vectors()
    rows, columns = sides
    scales, loss = (constants[SMOOTH], constants[COOL]), loss_rates(constants)
    sums = np.empty((12, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (vx, vy, vz) = three(columns, 0, first, last), three(columns, VELOCITY, first, last)
            f, g = three(sums, 0, first, last), three(sums, COLUMN_OUT, first, last)
            (weight, inverse, share) = three(columns, WEIGHT, first, last)
            inverse_rate, share_rate = columns[INVERSE_RATE, first:last], columns[SHARE_RATE, first:last]
            for i in range(low, high):
                (px, py, pz), row = point_of(rows, i), row_rates(rows, i)
                ax = ay = az = bx = by = bz = heat = heat_rate = rounding = rounding_rate = px * ZERO
                seen = kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset, velocity = (qx[j] - px, qy[j] - py, qz[j] - pz), (vx[j], vy[j], vz[j])
                    squared, half_rate = dot(offset, offset), dot(offset, velocity)
                    e, distance, over, distance_rate = measured_rate(seen, j, squared, half_rate, scales)
                    rates = logit_rate(distance, distance_rate, loss[0], loss[3]), distance_rate
                    column = weight[j], inverse[j], share[j], inverse_rate[j], share_rate[j]
                    slopes = slope_rate((e, distance), rates, row, column, loss)
                    factor = slopes[1] * over
                    factor_rate = (slopes[3] - factor * distance_rate) * over
                    heat += slopes[0] * distance
                    heat_rate += slopes[2] * distance + slopes[0] * distance_rate
                    rounding, rounding_rate = rounding + factor, rounding_rate + factor_rate
                    x, y, z = scaled(offset, factor)
                    ax, ay, az = ax - x, ay - y, az - z
                    add_at(f, j, (x, y, z))
                    x, y, z = plus(scaled(offset, factor_rate), scaled(velocity, factor))
                    bx, by, bz = bx - x, by - y, bz - z
                    add_at(g, j, (x, y, z))
                add_three(out[0], 0, i, (ax, ay, az))
                add_three(out[0], ROW_OUT, i, (bx, by, bz))
                add_sums(out[0], i, (heat, rounding), (heat_rate, rounding_rate))
        add_up(out[1], sums)


@compiled(forceinline=True)
def add_sums(out, i, sums, rates):  # type: ignore[no-untyped-def]
    """Add to the sums for temperature and rounding, and to their rates."""
    out[HEAT, i] += sums[0]
    out[ROUND, i] += sums[1]
    out[HEAT + ROW_OUT, i] += rates[0]
    out[ROUND + ROW_OUT, i] += rates[1]
