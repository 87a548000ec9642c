"""How far apart features are, squared, of all pairs of an item: what the sweeps of ``cpu_features.py`` read; compiled.

Features do not move with the pose. Their squares are found once, and what a whole registration says about them is
added up in one table of the same size before it is taken back to the features.
"""

from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload

from bbr_layer.kernels.cpu_compiling import compiled

# Pairs of an item whose table is held, 128 MiB in float32, and as much again for what is added up. Chosen.
MOST_PAIRS = 2**25
# Squares at padded points: their exponentials are as small as those of points far away (``cpu.FAR``).
FAR_SQUARED = 1e16
# Rows taken back to the features at a time, in float64.
ROWS = 512


class Apart(NamedTuple):
    """Squared distances of features, ``(n, m)``, in squared inner length units."""

    squares: np.ndarray


class Pulled(NamedTuple):
    """The same, and twice the derivative by them, which is added to: ``(n, m)`` each."""

    squares: np.ndarray
    pull: np.ndarray


def is_apart(kind: Any) -> bool:
    """Whether a compiled type is that of one of the two."""
    named = isinstance(kind, types.NamedTuple | types.NamedUniTuple)
    return named and kind.instance_class in (Apart, Pulled)


def normals_of(beside: Any) -> Any:
    """What is beside the points, if those are normals."""
    return None if isinstance(beside, Apart | Pulled) else beside


@overload(normals_of, inline="always")
def _normals_of(beside):  # type: ignore[no-untyped-def]
    return (lambda beside: None) if is_apart(beside) else (lambda beside: beside)


class Features(NamedTuple):
    """Features of a batch, in inner length units, and where their derivatives are put.

    Parameters
    ----------
    P, Q: ``(batch, n, c)`` and ``(batch, c, m)``.
    padded: which points are, ``(batch, n)`` and ``(batch, m)``; None: none.
    by_P, by_Q: float64, ``(batch, n, c)`` and ``(batch, m, c)``.
    """

    P: np.ndarray
    Q: np.ndarray
    padded: tuple[np.ndarray | None, np.ndarray | None]
    by_P: np.ndarray
    by_Q: np.ndarray

    def apart(self, b: int) -> Apart:
        """The squares of item ``b``."""
        squares = np.zeros((self.P.shape[1], self.Q.shape[2]), self.P.dtype)
        add_squares(self.P[b], self.Q[b], squares)
        P_padded, Q_padded = self.padded
        if P_padded is not None:
            squares[P_padded[b]] = FAR_SQUARED
        if Q_padded is not None:
            squares[:, Q_padded[b]] = FAR_SQUARED
        return Apart(squares)

    def pulled(self, b: int) -> Pulled:
        """The same, with room for what is added up."""
        squares = self.apart(b).squares
        return Pulled(squares, np.zeros_like(squares))

    def take_back(self, b: int, pull: np.ndarray) -> None:
        """Put what was added up for item ``b`` to its features, whose squares are ``|g - f|^2``."""
        f, g = self.P[b].astype(np.float64), self.Q[b].T.astype(np.float64)
        self.by_Q[b] = 0.0
        for first in range(0, len(f), ROWS):
            part, own = pull[first : first + ROWS].astype(np.float64), f[first : first + ROWS]
            self.by_P[b, first : first + ROWS] = own * part.sum(1)[:, None] - part @ g
            self.by_Q[b] += g * part.sum(0)[:, None] - part.T @ own
        for side, padded in zip((self.by_P, self.by_Q), self.padded, strict=True):
            if padded is not None:
                side[b][padded[b]] = 0.0


@compiled()
def add_squares(f, g, squares):  # type: ignore[no-untyped-def]
    """Add ``|g_j - f_i|^2`` to ``squares (n, m)``, from ``f (n, c)`` and ``g (c, m)``, by explicit differences."""
    for i in range(squares.shape[0]):
        row = squares[i]
        for k in range(g.shape[0]):
            column, own = g[k], f[i, k]
            for j in range(row.size):
                difference = column[j] - own
                row[j] += difference * difference
