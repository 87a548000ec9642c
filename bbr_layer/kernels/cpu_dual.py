"""The sweeps of ``cpu_sweeps`` in dual numbers: rates of change as the columns, their normals and alpha change.

Arguments as there; columns also hold velocities, the columns' normals theirs in channels 3 to 5, everything summed has
its rate of change behind it, and what is kept goes on with the rates of the distances.
"""

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_limits import limit_of
from bbr_layer.kernels.cpu_math import (
    ALIGN,
    CHUNK,
    COOL,
    COOL_RATE,
    INVERSE,
    INVERSE_RATE,
    SMOOTH,
    TILE,
    TWO,
    VELOCITY,
    WEIGHT,
    ZERO,
    share_of,
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
    plane_square_rate,
    point_of,
    three,
)


@compiled()
def denominator_rates(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """Sums of exp(-D / alpha) and their rates: channels 0 and 1 of both ``out``."""
    wide_vectors()
    rows, columns = sides
    scales, align, cool_rate = (constants[SMOOTH], constants[COOL]), constants[ALIGN], constants[COOL_RATE]
    limit = limit_of(normals)
    sums = np.empty((2, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (vx, vy, vz) = three(columns, 0, first, last), three(columns, VELOCITY, first, last)
            total, total_rate = sums[0, first:last], sums[1, first:last]
            if normals is not None:
                (nx, ny, nz), (mx, my, mz) = three(normals[1], 0, first, last), three(normals[1], 3, first, last)
            for i in range(low, high):
                px, py, pz = point_of(rows, i)
                if normals is not None:
                    normal = point_of(normals[0], i)
                row = row_rate = px * ZERO
                seen = kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset, velocity = (qx[j] - px, qy[j] - py, qz[j] - pz), (vx[j], vy[j], vz[j])
                    if normals is None:
                        squared, half_rate = dot(offset, offset), dot(offset, velocity)
                    else:
                        around = normal, (nx[j], ny[j], nz[j]), (mx[j], my[j], mz[j])
                        squared, half_rate = plane_square_rate((offset, velocity), around, align, limit)
                    e, distance, _, distance_rate = measured_rate(None, j, squared, half_rate, scales)
                    if kept is not None:
                        seen[0][j], seen[1][j], seen[2][j] = e, distance, distance_rate
                    e_rate = e * logit_rate(distance, distance_rate, scales[1], cool_rate)
                    row += e
                    row_rate += e_rate
                    total[j] += e
                    total_rate[j] += e_rate
                out[0][0, i] += row
                out[0][1, i] += row_rate
        add_up(out[1], sums)


@compiled(forceinline=True)
def weights_of(rows, i):  # type: ignore[no-untyped-def]
    """Weight, inverse denominator and its rate of row ``i``."""
    return rows[WEIGHT, i], rows[INVERSE, i], rows[INVERSE_RATE, i]


@compiled()
def buddy_sum_rates(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """Sums of buddies and of buddies times distance, and the rates of the two: channels 0 to 3 of both ``out``."""
    wide_vectors()
    (rows, columns), limit = sides, limit_of(normals)
    scales, align, cool_rate = (constants[SMOOTH], constants[COOL]), constants[ALIGN], constants[COOL_RATE]
    sums = np.empty((4, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (vx, vy, vz) = three(columns, 0, first, last), three(columns, VELOCITY, first, last)
            weight, inverse = columns[WEIGHT, first:last], columns[INVERSE, first:last]
            rate = columns[INVERSE_RATE, first:last]
            counts, lengths_rate = three(sums, 0, first, last), sums[3, first:last]
            if normals is not None:
                (nx, ny, nz), (mx, my, mz) = three(normals[1], 0, first, last), three(normals[1], 3, first, last)
            for i in range(low, high):
                (px, py, pz), seen = point_of(rows, i), kept_row(kept, i, first, last)
                own, own_inverse, own_rate = weights_of(rows, i)
                if normals is not None:
                    normal = point_of(normals[0], i)
                a = b = a_rate = b_rate = px * ZERO
                for j in range(qx.size):
                    offset, velocity = (qx[j] - px, qy[j] - py, qz[j] - pz), (vx[j], vy[j], vz[j])
                    if normals is None:
                        squared, half_rate = dot(offset, offset), dot(offset, velocity)
                    else:
                        around = normal, (nx[j], ny[j], nz[j]), (mx[j], my[j], mz[j])
                        squared, half_rate = plane_square_rate((offset, velocity), around, align, limit)
                    e, distance, _, distance_rate = measured_rate(seen, j, squared, half_rate, scales)
                    buddies = share_of(e, own_inverse) * share_of(e, inverse[j])
                    change = TWO * logit_rate(distance, distance_rate, scales[1], cool_rate) - own_rate - rate[j]
                    buddies_rate, length_rate = buddies * change, buddies * (change * distance + distance_rate)
                    a, b = a + buddies * weight[j], b + buddies * weight[j] * distance
                    a_rate, b_rate = a_rate + buddies_rate * weight[j], b_rate + length_rate * weight[j]
                    add_at(counts, j, (buddies * own, buddies * own * distance, buddies_rate * own))
                    lengths_rate[j] += length_rate * own
                add_three(out[0], 0, i, (a, b, a_rate))
                out[0][3, i] += b_rate
        add_up(out[1], sums)
