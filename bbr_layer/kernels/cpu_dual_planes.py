"""The last sweep of a point-to-plane loss in dual numbers; arguments and sums as in ``cpu_dual_forces.py``."""

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_dual_forces import add_sums, loss_rates, point_force_rates, row_rates
from bbr_layer.kernels.cpu_limits import clipped, if_free, limit_of
from bbr_layer.kernels.cpu_math import (
    ALIGN,
    CHUNK,
    COLUMN_OUT,
    INVERSE_RATE,
    ONE,
    ROW_OUT,
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
    logit_rate,
    measured_rate,
    plane,
    point_of,
    scaled,
    slope_rate,
    three,
)


@compiled(forceinline=True)
def pushes(offsets, normals, scales, others, limit):  # type: ignore[no-untyped-def]
    """Of one pair (point to plane): sign, force along the normals and its rate, the two sums, and their rates.

    ``offsets`` are (offset, velocity), ``normals`` (row's, column's, velocity of the column's), ``scales`` (smoothing
    squared, 1 to align signs), ``others`` (row, column, loss) of ``slope_rate``, ``limit`` as ``limit_of``.
    """
    (offset, velocity), loss = offsets, others[2]
    sign, total, residual = plane(offset, normals[0], normals[1], scales[1])
    residual_rate = dot(velocity, total) + dot(offset, normals[2])
    squared = residual * residual
    half_rate, shown = if_free(residual * residual_rate, squared, limit), clipped(squared, limit)
    e, distance, over, distance_rate = measured_rate(None, 0, shown, half_rate, (scales[0], loss[0]))
    over = if_free(over, squared, limit)
    rates = logit_rate(distance, distance_rate, loss[0], loss[3]), distance_rate
    slopes = slope_rate((e, distance), rates, others[0], others[1], loss)
    factor = slopes[1] * over
    factor_rate = (slopes[3] - factor * distance_rate) * over
    heat, heat_rate = slopes[0] * distance, slopes[2] * distance + slopes[0] * distance_rate
    return (
        sign,
        factor * residual,
        factor_rate * residual + factor * residual_rate,
        (heat, factor),
        (heat_rate, factor_rate),
    )


@compiled(forceinline=True)
def add_products(out, row, vectors, pushed, signs):  # type: ignore[no-untyped-def]
    """Add ``push * vector`` to the columns and, times the sign, to the row; and its rate, by the product rule.

    The vector is ``vectors[0] + signs[0] * row`` and changes by ``vectors[1]``; ``out`` are slices: three sums, three
    rates. What is added to the row, times ``signs[1]``, is answered: the sum and its rate.
    """
    f, g = out
    (qx, qy, qz), (vx, vy, vz) = vectors
    push, push_rate = pushed
    zero = push[0] * ZERO
    ax = ay = az = bx = by = bz = zero
    for j in range(push.size):
        x, y, z = qx[j] + signs[0][j] * row[0], qy[j] + signs[0][j] * row[1], qz[j] + signs[0][j] * row[2]
        rx, ry, rz = (
            push_rate[j] * x + push[j] * vx[j],
            push_rate[j] * y + push[j] * vy[j],
            push_rate[j] * z + push[j] * vz[j],
        )
        x, y, z = push[j] * x, push[j] * y, push[j] * z
        add_at(f, j, (x, y, z))
        add_at(g, j, (rx, ry, rz))
        ax, ay, az = ax + signs[1][j] * x, ay + signs[1][j] * y, az + signs[1][j] * z
        bx, by, bz = bx + signs[1][j] * rx, by + signs[1][j] * ry, bz + signs[1][j] * rz
    return (ax, ay, az), (bx, by, bz)


@compiled()
def plane_force_rates(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """``plane_forces`` and their rates, nothing kept used: what each pair pushes, points and normals."""
    wide_vectors()
    rows, columns = sides
    scales, loss, limit = (constants[SMOOTH], constants[ALIGN]), loss_rates(constants), limit_of(normals)
    buffer = np.ones((4, min(TILE, columns.shape[1])), dtype=rows.dtype)
    sums = np.empty((12, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (vx, vy, vz) = three(columns, 0, first, last), three(columns, VELOCITY, first, last)
            (nx, ny, nz), (mx, my, mz) = three(normals[1], 0, first, last), three(normals[1], 3, first, last)
            (weight, inverse, share) = three(columns, WEIGHT, first, last)
            inverse_rate, share_rate = columns[INVERSE_RATE, first:last], columns[SHARE_RATE, first:last]
            (sign, push, push_rate), ones = three(buffer, 0, 0, last - first), buffer[3, : last - first]
            for i in range(low, high):
                (px, py, pz), row = point_of(rows, i), row_rates(rows, i)
                normal = point_of(normals[0], i)
                heat = heat_rate = rounding = rounding_rate = px * ZERO
                for j in range(qx.size):
                    column = weight[j], inverse[j], share[j], inverse_rate[j], share_rate[j]
                    offsets = (qx[j] - px, qy[j] - py, qz[j] - pz), (vx[j], vy[j], vz[j])
                    around = normal, (nx[j], ny[j], nz[j]), (mx[j], my[j], mz[j])
                    sign[j], push[j], push_rate[j], s, r = pushes(offsets, around, scales, (row, column, loss), limit)
                    heat, rounding = heat + s[0], rounding + s[1]
                    heat_rate, rounding_rate = heat_rate + r[0], rounding_rate + r[1]
                into = three(sums, 0, first, last), three(sums, COLUMN_OUT, first, last)
                vectors = (nx, ny, nz), (mx, my, mz)
                force, force_rate = add_products(into, normal, vectors, (push, push_rate), (sign, ones))
                into = three(sums, 3, first, last), three(sums, COLUMN_OUT + 3, first, last)
                vectors = (qx, qy, qz), (vx, vy, vz)
                torque, torque_rate = add_products(into, (-px, -py, -pz), vectors, (push, push_rate), (ones, sign))
                add_three(out[0], 0, i, scaled(force, -ONE))
                add_three(out[0], ROW_OUT, i, scaled(force_rate, -ONE))
                add_three(out[0], 3, i, torque)
                add_three(out[0], ROW_OUT + 3, i, torque_rate)
                add_sums(out[0], i, (heat, rounding), (heat_rate, rounding_rate))
        add_up(out[1], sums)


@compiled()
def force_rates(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """The last sweep in dual numbers, whichever the distance."""
    if normals is None:
        point_force_rates(sides, normals, out, constants, kept)
    else:
        plane_force_rates(sides, normals, out, constants, kept)
