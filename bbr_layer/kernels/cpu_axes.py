"""The principal axes of neighbourhoods in space, compiled: mean, covariance and Jacobi's rotations, point by point."""

import numpy as np

from bbr_layer.kernels.cpu_compiling import exact

# Rounds of Jacobi's three rotations. They converge quadratically: five leave off-diagonals of 1e-16 of the largest.
ROUNDS = 6


@exact
def _covariance(points, rows, into):  # type: ignore[no-untyped-def]
    """Mean outer product of the offsets of ``points[rows]`` from their mean, ``(3, 3)``."""
    centre, offset = np.zeros(3), np.empty(3)
    for row in rows:
        for a in range(3):
            centre[a] += points[row, a] / len(rows)
    into[:] = 0.0
    for row in rows:
        for a in range(3):
            offset[a] = points[row, a] - centre[a]
        for a in range(3):
            for b in range(3):
                into[a, b] += offset[a] * offset[b] / len(rows)


@exact
def _diagonalise(matrix, vectors):  # type: ignore[no-untyped-def]
    """Turn a symmetric ``(3, 3)`` into its eigenvalues on the diagonal, ``vectors`` into its eigenvectors by column.

    Golub and Van Loan, Matrix Computations, section 8.5.
    """
    vectors[:] = 0.0
    for a in range(3):
        vectors[a, a] = 1.0
    for _ in range(ROUNDS):
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                slope = (matrix[q, q] - matrix[p, p]) / (2 * matrix[p, q])
                tangent = (1.0 if slope >= 0 else -1.0) / (abs(slope) + np.sqrt(1 + slope * slope))
                cosine = 1 / np.sqrt(1 + tangent * tangent)
                sine = tangent * cosine
                for k in range(3):
                    left, right = matrix[k, p], matrix[k, q]
                    matrix[k, p], matrix[k, q] = cosine * left - sine * right, sine * left + cosine * right
                for k in range(3):
                    left, right = matrix[p, k], matrix[q, k]
                    matrix[p, k], matrix[q, k] = cosine * left - sine * right, sine * left + cosine * right
                for k in range(3):
                    left, right = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = cosine * left - sine * right, sine * left + cosine * right


@exact
def _rising(matrix):  # type: ignore[no-untyped-def]
    """Where on the diagonal the least, the middle and the greatest number stand."""
    least = greatest = 0
    for a in range(1, 3):
        if matrix[a, a] < matrix[least, least]:
            least = a
        if matrix[a, a] >= matrix[greatest, greatest]:
            greatest = a
    return least, 3 - least - greatest, greatest


@exact
def axes(points, index, variances, vectors):  # type: ignore[no-untyped-def]
    """Of every row of ``index (n, k)`` the variances ``(n, 3)``, least first, along ``vectors (n, 3, 3)`` by column."""
    matrix, turned = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(index)):
        _covariance(points, index[i], matrix)
        _diagonalise(matrix, turned)
        order = _rising(matrix)
        for a in range(3):
            variances[i, a] = matrix[order[a], order[a]]
            for k in range(3):
                vectors[i, k, a] = turned[k, order[a]]
