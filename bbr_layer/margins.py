"""Nearest neighbours of slowly moving points: those that cannot have changed are not looked up again."""

import numpy as np
from jaxtyping import Bool, Float, Int

from bbr_layer.trees import Tree, squared_length

# Computed lengths are off by a few 2^-53 of themselves; this share covers them many times over.
ROUNDING = 1e-12


class Margins:
    """Exact nearest neighbours in a fixed tree, remembered from one asking to the next.

    Found at ``y`` with nearest and second distances ``d1`` and ``d2``: at ``y'`` every other point is at least
    ``d2 - |y' - y|`` away (triangle inequality), so the neighbour stays while its own distance is below that; which is
    certain while ``|y' - y| < (d2 - d1) / 2``. Any order of askings gets the same answers.

    Parameters
    ----------
    tree: the cloud that is searched.
    count: how many moving points there are.
    kept: False looks up every point at every asking.

    Attributes
    ----------
    asked, looked_up: how many neighbours were wanted so far, and how many of them the tree was searched for.
    """

    def __init__(self, tree: Tree, count: int, kept: bool = True):
        self.tree, self.kept = tree, kept
        self.index = np.zeros(count, dtype=np.int64)
        self.second = np.zeros(count)  # d2
        self.free = np.full(count, -1.0)  # square of what a point may move for certain; -1: never looked up
        self.places = np.zeros((count, tree.points.shape[1]))  # y
        self.asked = self.looked_up = 0

    def nearest(
        self, queries: Float[np.ndarray, "m d"], wanted: Bool[np.ndarray, "m"] | None = None
    ) -> Int[np.ndarray, "m"]:
        """Index of the nearest point of the tree, right for the ``wanted`` ones of the moving points (None: all)."""
        asked = len(queries) if wanted is None else int(np.count_nonzero(wanted))
        expired = self._expired(queries, wanted)
        self.asked += asked
        self.looked_up += len(expired)
        if len(expired):
            at = queries.take(expired, axis=0)
            index, first, second = self.tree.nearest(at)
            self.index[expired], self.second[expired], self.places[expired] = index, second, at
            self.free[expired] = np.square((second - first) * (0.5 - ROUNDING))
        return self.index

    def _expired(self, queries: np.ndarray, wanted: np.ndarray | None) -> Int[np.ndarray, "k"]:
        """The wanted rows whose neighbour may have changed since it was found."""
        if not self.kept:
            return np.arange(len(queries)) if wanted is None else np.flatnonzero(wanted)
        offsets = queries - self.places
        moved = np.einsum("md,md->m", offsets, offsets)
        doubtful = ~(moved < self.free)
        rows = np.flatnonzero(doubtful if wanted is None else doubtful & wanted)
        at, own = queries.take(rows, axis=0), self.tree.points.take(self.index[rows], axis=0)
        least = np.sqrt(squared_length(at - own)) + np.sqrt(moved[rows])
        return rows[~(least * (1 + ROUNDING) < self.second[rows])]
