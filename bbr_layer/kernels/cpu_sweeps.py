"""The first two sweeps of the gradient over rows against all columns, compiled; formulas as in ``reference.py``.

Every sweep takes ``(sides, normals, out, constants, kept)``: channels by points of rows and columns (see ``cpu_math``),
the normals of both or None for point-to-point distances, sums per row and per column to be added to, the item's
constants, and ``(exponentials, distances)``, each rows by columns, that the first sweep fills for the others (None:
each computes its own). The innermost loops run over plain slices, in which LLVM finds its vectors.
"""

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_limits import limit_of
from bbr_layer.kernels.cpu_math import ALIGN, CHUNK, COOL, INVERSE, SMOOTH, TILE, WEIGHT, ZERO, share_of, wide_vectors
from bbr_layer.kernels.cpu_pairs import add_up, dot, kept_row, measured, plane_square, point_of, three


@compiled()
def denominators(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """Sums of exp(-D / alpha): per row into ``out[0][0]``, per column into ``out[1][0]``."""
    wide_vectors()
    rows, columns = sides
    scales, align, limit = (constants[SMOOTH], constants[COOL]), constants[ALIGN], limit_of(normals)
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
                seen = kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    if normals is None:
                        squared = dot(offset, offset)
                    else:
                        squared = plane_square(offset, (normal, (nx[j], ny[j], nz[j])), align, limit)
                    e, distance, _ = measured(None, j, squared, scales)
                    if kept is not None:
                        seen[0][j], seen[1][j] = e, distance
                    row += e
                    total[j] += e
                out[0][0, i] += row
        add_up(out[1], sums)


@compiled()
def buddy_sums(sides, normals, out, constants, kept):  # type: ignore[no-untyped-def]
    """Sums of buddies and of buddies times distance, weighted by the other side: channels 0 and 1 of both ``out``."""
    wide_vectors()
    rows, columns = sides
    scales, align, limit = (constants[SMOOTH], constants[COOL]), constants[ALIGN], limit_of(normals)
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
                seen = kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset = qx[j] - px, qy[j] - py, qz[j] - pz
                    if normals is None:
                        squared = dot(offset, offset)
                    else:
                        squared = plane_square(offset, (normal, (nx[j], ny[j], nz[j])), align, limit)
                    e, distance, _ = measured(seen, j, squared, scales)
                    buddies = share_of(e, row_inverse) * share_of(e, inverse[j])
                    row_count += buddies * weight[j]
                    row_lengths += buddies * weight[j] * distance
                    count[j] += buddies * own
                    lengths[j] += buddies * own * distance
                out[0][0, i] += row_count
                out[0][1, i] += row_lengths
        add_up(out[1], sums)
