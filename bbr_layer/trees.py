"""A KD-tree over one cloud in 2D or 3D, with ties settled as brute force settles them."""

import numpy as np
from jaxtyping import Float, Int
from small_gicp import KdTree

from bbr_layer.threads import library_threads

# Squared distances that differ by less than this share may be a tie but for rounding (3 sums, 2^-53 each): such
# candidates are compared by explicit differences.
TIE = 1e-12
# Computed lengths are off by a few 2^-53 of themselves; this share covers them many times over.
ROUNDING = 1e-12
# Points in each point's list of its nearest. Chosen on two full lidar scans, where half as many left more searches to
# the tree and more saved no time.
LISTED = 16
# Candidate distances held at once while ties are settled: 2^20 float64 are 8 MiB.
PAIRS_PER_TILE = 2**20
# Queries that are worth more than one thread. Chosen: so many take about a millisecond.
FOR_THREADS = 512


class Tree:
    """Exact nearest points of a cloud, float64; of several equally near ones the first in the cloud's order.

    Parameters
    ----------
    points: ``(n, d)``, d = 2 or 3, at least one.
    """

    def __init__(self, points: Float[np.ndarray, "n d"]):
        self.points = points
        self.kept: np.ndarray | None = None  # which points are in the tree; None: all of them
        self.tree = KdTree(in_space(points))
        self._lists: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.points) if self.kept is None else len(self.kept)

    @property
    def listed(self) -> bool:
        """Whether the lists are there already."""
        return self._lists is not None

    def __getstate__(self) -> tuple:
        return self.points, self.kept

    def __setstate__(self, state: tuple) -> None:
        self.points, self.kept = state
        self._lists = None
        self.tree = KdTree(in_space(self.points if self.kept is None else self.points[self.kept]))

    def candidates(self, queries: Float[np.ndarray, "m d"], count: int) -> tuple[np.ndarray, np.ndarray]:
        """The ``count`` nearest points of each query, near to far: squared distances and indices, ``(m, count)``."""
        threads = library_threads() if len(queries) >= FOR_THREADS else 1
        index, squared = self.tree.batch_knn_search(in_space(queries), count, num_threads=threads)
        index = index.astype(np.int64)
        return squared, index if self.kept is None else self.kept[index]

    def lists(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The points in space, each one's ``LISTED`` nearest (int32), and a distance within which no other one lies.

        Built at the first call.
        """
        if self._lists is None:
            squared, index = self.candidates(self.points, min(LISTED, len(self)))
            reach = np.sqrt(squared[:, -1]) if LISTED < len(self) else np.full(len(self.points), np.inf)
            self._lists = np.ascontiguousarray(in_space(self.points)), index.astype(np.int32), reach
        return self._lists

    def nearest(self, queries: Float[np.ndarray, "m d"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Index of the nearest point, its distance, and the distance of the next other one, each ``(m,)``."""
        if len(self) == 1:
            squared, index = self.candidates(queries, 1)
            return index[:, 0], np.sqrt(squared[:, 0]), np.full(len(queries), np.inf)
        squared, index = self.candidates(queries, 2)
        tied = np.flatnonzero(squared[:, 1] <= squared[:, 0] * (1 + TIE))
        if self.kept is None and (self.points[index[tied, 0]] == self.points[index[tied, 1]]).all(1).any():
            self._drop_duplicates()
            return self.nearest(queries)
        index = index[:, 0].copy()
        index[tied] = self._first_of_ties(queries[tied])
        distances = np.sqrt(squared)
        return index, distances[:, 0], distances[:, 1]

    def _drop_duplicates(self) -> None:
        """Keep the first of every set of coincident points: the others are never an answer, and crowd the ties."""
        self.kept = np.sort(np.unique(self.points, axis=0, return_index=True)[1])
        self.tree = KdTree(in_space(self.points[self.kept]))
        self._lists = None

    def _first_of_ties(self, queries: np.ndarray) -> Int[np.ndarray, "m"]:
        found = np.zeros(len(queries), dtype=np.int64)
        open_rows, count = np.arange(len(queries)), 2
        while len(open_rows):
            count = min(2 * count, len(self))
            rows = max(1, PAIRS_PER_TILE // count)
            undecided = []
            for part in (open_rows[i : i + rows] for i in range(0, len(open_rows), rows)):
                squared, index = self.candidates(queries[part], count)
                found[part] = self._first(queries[part], index)
                undecided.append(part[squared[:, -1] <= squared[:, 0] * (1 + TIE)])
            open_rows = np.concatenate(undecided) if count < len(self) else open_rows[:0]
        return found

    def _first(self, queries: np.ndarray, index: np.ndarray) -> Int[np.ndarray, "m"]:
        """Of each row's candidates the nearest by explicit differences, the first in the cloud's order if several."""
        index = np.sort(index, axis=1)
        squared = squared_length(self.points[index] - queries[:, None])
        return np.take_along_axis(index, squared.argmin(1)[:, None], axis=1)[:, 0]


def squared_length(offsets: Float[np.ndarray, "*rows d"]) -> Float[np.ndarray, "*rows"]:
    """Sum of squares over the last axis, the axes added in their order."""
    squared = np.square(offsets[..., 0])
    for axis in range(1, offsets.shape[-1]):
        squared += np.square(offsets[..., axis])
    return squared


def in_space(points: Float[np.ndarray, "*rows d"]) -> Float[np.ndarray, "*rows 3"]:
    """Points of the plane at height 0, which changes no distance; points of space as they are."""
    if points.shape[-1] == 3:
        return points
    placed = np.zeros((*points.shape[:-1], 3), points.dtype)  # np.pad costs more than the search of a few points
    placed[..., : points.shape[-1]] = points
    return placed
