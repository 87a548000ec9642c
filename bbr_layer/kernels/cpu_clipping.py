"""Distances of Eq. 7 that are clipped, and where: from all pairs of an item at once; compiled.

Normals of a loss that clips are ``(rows, columns, limit)``, the last ``(1,)`` for the largest square a distance may
have. Which of the two is known by type: a loss that does not clip pays nothing.
"""

from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_math import ALIGN, ZERO, wide_vectors
from bbr_layer.kernels.cpu_pairs import plane, point_of, three


def settle_limit(sides: Any, normals: Any, constants: Any, clip: float) -> None:
    """Find the limit: ``clip`` standard deviations of the squares above their mean, as ``blocks.clipping_distance``."""
    if normals is not None and len(normals) == 3:
        _settle_limit(sides, normals, constants, clip)


@compiled()
def _settle_limit(sides, normals, constants, clip):  # type: ignore[no-untyped-def]
    wide_vectors()
    rows, align, count = sides[0], constants[ALIGN], sides[1].shape[1]
    (qx, qy, qz), (nx, ny, nz) = three(sides[1], 0, 0, count), three(normals[1], 0, 0, count)
    total = squares = 0.0
    for i in range(rows.shape[1]):
        (px, py, pz), normal = point_of(rows, i), point_of(normals[0], i)
        row = row_squares = px * ZERO
        for j in range(count):
            offset = qx[j] - px, qy[j] - py, qz[j] - pz
            residual = plane(offset, normal, (nx[j], ny[j], nz[j]), align)[2]
            squared = residual * residual
            row += squared
            row_squares += squared * squared
        total += row
        squares += row_squares
    pairs = rows.shape[1] * count
    mean = total / pairs
    # The rounding is in every square alike: it moves their mean, and not their deviation.
    normals[2][0] = mean + clip * np.sqrt(max(squares / pairs - mean * mean, 0.0))


@overload(settle_limit)
def _chosen(sides, normals, constants, clip):  # type: ignore[no-untyped-def]
    if normals == types.none or len(normals) != 3:
        return lambda sides, normals, constants, clip: None
    return lambda sides, normals, constants, clip: _settle_limit(sides, normals, constants, clip)
