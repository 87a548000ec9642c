"""The three sweeps of the gradient over a block of rows against all columns, compiled; formulas as in ``reference.py``.

Every sweep takes ``(rows, columns, normals, out, constants)``: channels by points (see ``cpu_math``), the normals of
both or None for point-to-point distances, sums per row and per column to be added to, and the item's constants. The
innermost loops run over plain slices, in which LLVM finds its vectors.
"""

import numpy as np

from bbr_layer.kernels.cpu_math import (
    ALIGN,
    BY_M,
    BY_S,
    CHUNK,
    COOL,
    HEAT,
    INVERSE,
    ROUND,
    SHARE,
    SMOOTH,
    TILE,
    WEIGHT,
    ZERO,
    compiled,
    exp_negative,
)
from bbr_layer.kernels.cpu_pairs import add_at, add_three, add_up, dot, length, plane, point_of, scaled, slope, three


@compiled()
def denominators(rows, columns, normals, out, constants):  # type: ignore[no-untyped-def]
    """Sums of exp(-D / alpha): per row into ``out[0][0]``, per column into ``out[1][0]``."""
    smooth, cool, align = constants[SMOOTH], constants[COOL], constants[ALIGN]
    sums = np.empty((1, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            qx, qy, qz = three(columns, 0, first, last)
            total = sums[0, first:last]
            if normals is not None:
                nx, ny, nz = three(normals[1], 0, first, last)
            for i in range(low, high):
                px, py, pz = point_of(rows, i)
                if normals is not None:
                    normal = point_of(normals[0], i)
                row = px * ZERO
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    if normals is None:
                        distance, _ = length(dot(offset, offset), smooth)
                    else:
                        _, _, residual = plane(offset, normal, (nx[j], ny[j], nz[j]), align)
                        distance, _ = length(residual * residual, smooth)
                    e = exp_negative(-distance * cool)
                    row += e
                    total[j] += e
                out[0][0, i] += row
        add_up(out[1], sums)


@compiled()
def buddy_sums(rows, columns, normals, out, constants):  # type: ignore[no-untyped-def]
    """Sums of buddies and of buddies times distance, weighted by the other side: channels 0 and 1 of both ``out``."""
    smooth, cool, align = constants[SMOOTH], constants[COOL], constants[ALIGN]
    sums = np.empty((2, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            qx, qy, qz = three(columns, 0, first, last)
            weight, inverse = columns[WEIGHT, first:last], columns[INVERSE, first:last]
            count, lengths = sums[0, first:last], sums[1, first:last]
            if normals is not None:
                nx, ny, nz = three(normals[1], 0, first, last)
            for i in range(low, high):
                (px, py, pz), own, row_inverse = point_of(rows, i), rows[WEIGHT, i], rows[INVERSE, i]
                if normals is not None:
                    normal = point_of(normals[0], i)
                row_count = row_lengths = px * ZERO
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    if normals is None:
                        distance, _ = length(dot(offset, offset), smooth)
                    else:
                        _, _, residual = plane(offset, normal, (nx[j], ny[j], nz[j]), align)
                        distance, _ = length(residual * residual, smooth)
                    e = exp_negative(-distance * cool)
                    buddies = (e * row_inverse) * (e * inverse[j])
                    row_count += buddies * weight[j]
                    row_lengths += buddies * weight[j] * distance
                    count[j] += buddies * own
                    lengths[j] += buddies * own * distance
                out[0][0, i] += row_count
                out[0][1, i] += row_lengths
        add_up(out[1], sums)


@compiled()
def point_forces(rows, columns, normals, out, constants):  # type: ignore[no-untyped-def]
    """The gradient of a point-to-point loss: the force on each row and column, channels 0 to 2 of both ``out``.

    Channels ``HEAT`` and ``ROUND`` of ``out[0]``: sums of dL/du D and of dL/dD / D, for temperature and rounding.
    """
    smooth, loss = constants[SMOOTH], (constants[COOL], constants[BY_S], constants[BY_M])
    sums = np.empty((3, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            qx, qy, qz = three(columns, 0, first, last)
            f = three(sums, 0, first, last)
            weight, inverse, share = three(columns, WEIGHT, first, last)
            for i in range(low, high):
                px, py, pz = point_of(rows, i)
                row = rows[WEIGHT, i], rows[INVERSE, i], rows[SHARE, i]
                gx = gy = gz = heat = rounding = px * ZERO
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    distance, over = length(dot(offset, offset), smooth)
                    e = exp_negative(-distance * loss[0])
                    by_logit, by_distance = slope(e, distance, row, (weight[j], inverse[j], share[j]), loss)
                    factor = by_distance * over
                    heat += by_logit * distance
                    rounding += factor
                    x, y, z = scaled(offset, factor)
                    gx, gy, gz = gx - x, gy - y, gz - z
                    add_at(f, j, (x, y, z))
                add_three(out[0], 0, i, (gx, gy, gz))
                out[0][HEAT, i] += heat
                out[0][ROUND, i] += rounding
        add_up(out[1], sums)


@compiled()
def plane_forces(rows, columns, normals, out, constants):  # type: ignore[no-untyped-def]
    """The gradient of a point-to-plane loss: as ``point_forces``, and the derivatives by normals in channels 3 to 5."""
    smooth, align, loss = constants[SMOOTH], constants[ALIGN], (constants[COOL], constants[BY_S], constants[BY_M])
    sums = np.empty((6, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (nx, ny, nz) = three(columns, 0, first, last), three(normals[1], 0, first, last)
            f, t = three(sums, 0, first, last), three(sums, 3, first, last)
            weight, inverse, share = three(columns, WEIGHT, first, last)
            for i in range(low, high):
                px, py, pz = point_of(rows, i)
                normal = point_of(normals[0], i)
                row = rows[WEIGHT, i], rows[INVERSE, i], rows[SHARE, i]
                gx = gy = gz = ux = uy = uz = heat = rounding = px * ZERO
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    sign, total, residual = plane(offset, normal, (nx[j], ny[j], nz[j]), align)
                    distance, over = length(residual * residual, smooth)
                    e = exp_negative(-distance * loss[0])
                    by_logit, by_distance = slope(e, distance, row, (weight[j], inverse[j], share[j]), loss)
                    factor = by_distance * over
                    heat += by_logit * distance
                    rounding += factor
                    x, y, z = scaled(offset, factor * residual)
                    ux, uy, uz = ux + sign * x, uy + sign * y, uz + sign * z
                    add_at(t, j, (x, y, z))
                    x, y, z = scaled(total, factor * residual)
                    gx, gy, gz = gx - x, gy - y, gz - z
                    add_at(f, j, (x, y, z))
                add_three(out[0], 0, i, (gx, gy, gz))
                add_three(out[0], 3, i, (ux, uy, uz))
                out[0][HEAT, i] += heat
                out[0][ROUND, i] += rounding
        add_up(out[1], sums)
