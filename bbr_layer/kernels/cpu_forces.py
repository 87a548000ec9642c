"""The last sweep of the gradient: forces on points and on normals; arguments as in ``cpu_sweeps.py``."""

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_limits import clipped, if_free, limit_of
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
    wide_vectors,
)
from bbr_layer.kernels.cpu_pairs import (
    add_at,
    add_three,
    add_up,
    dot,
    kept_row,
    measured,
    plane,
    point_of,
    scaled,
    slope,
    three,
)


@compiled()
def point_forces(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """The gradient of a point-to-point loss: the force on each row and column, channels 0 to 2 of both ``out``.

    Channels ``HEAT`` and ``ROUND`` of ``out[0]``: sums of dL/du D and of dL/dD / D, for temperature and rounding.
    """
    wide_vectors()
    rows, columns = sides
    scales, loss = (constants[SMOOTH], constants[COOL]), (constants[COOL], constants[BY_S], constants[BY_M])
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
                seen = kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    e, distance, over = measured(seen, j, dot(offset, offset), scales)
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
def plane_forces(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """The gradient of a point-to-plane loss: as ``point_forces``, and the derivatives by normals in channels 3 to 5."""
    wide_vectors()
    rows, columns = sides
    scales, align, limit = (constants[SMOOTH], constants[COOL]), constants[ALIGN], limit_of(normals)
    loss = constants[COOL], constants[BY_S], constants[BY_M]
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
                seen = kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    sign, total, residual = plane(offset, normal, (nx[j], ny[j], nz[j]), align)
                    squared = residual * residual
                    e, distance, over = measured(seen, j, clipped(squared, limit), scales)
                    by_logit, by_distance = slope(e, distance, row, (weight[j], inverse[j], share[j]), loss)
                    factor = if_free(by_distance * over, squared, limit)
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


@compiled()
def forces(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """The last sweep, whichever the distance."""
    if normals is None:
        point_forces(sides, normals, out, constants, kept)
    else:
        plane_forces(sides, normals, out, constants, kept)
