"""Nearest neighbours of slowly moving points: those that cannot have changed are not looked up again."""

import importlib.util
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from bbr_layer.trees import ROUNDING, Tree, in_space, squared_length

if TYPE_CHECKING:
    from bbr_layer.kernels.cpu_walk import Memory

COMPILED = importlib.util.find_spec("numba") is not None

# Points of clouds in which what the walk leaves open is compared with every point, rather than looked up in a tree from
# Python. Chosen: far from the answer, where most is left open, the tree soon wins; near it comparing does for longer,
# but there both are quick.
SMALL = 1024

Pose = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]


class Margins:
    """Exact nearest neighbours of a moving cloud in a fixed tree, remembered from one asking to the next.

    Found at ``y``, with every other point at least ``r`` away: at ``y'`` every other point is at least ``r - |y' - y|``
    away (triangle inequality), so the neighbour stays while its own distance is below that. Where it may have
    changed, the new one is walked to from the old one (``kernels/cpu_walk.py``; not without Numba) or, where that
    proves nothing, looked up in the tree. Any order of askings gets the same answers.

    Parameters
    ----------
    tree: the cloud that is searched.
    moving: ``(m, 3)`` the points before they move; those of the plane at height 0.
    kept: False looks up every point at every asking.

    Attributes
    ----------
    asked, searched, looked_up: how many neighbours were wanted so far, how many of them may have changed, and how
        many of those the tree was searched for.
    """

    def __init__(self, tree: Tree, moving: Float[np.ndarray, "m 3"], kept: bool = True):
        self.tree, self.moving, self.kept = tree, np.ascontiguousarray(moving), kept
        self.index = np.zeros(len(moving), dtype=np.int64)
        self.reach = np.full(len(moving), -1.0)  # r; -1: never looked up
        self.places = np.zeros((len(moving), 3))  # y
        self.distance = np.zeros(len(moving))  # of the nearest at the last asking
        self.everybody = np.ones(len(moving), dtype=bool)
        self.asked = self.searched = self.looked_up = 0
        self._tables: tuple | None = None

    def nearest(self, pose: Pose, wanted: Bool[np.ndarray, "m"] | None = None) -> Int[np.ndarray, "m"]:
        """Index of the nearest point of the tree to each moved point, right for the ``wanted`` ones (None: all)."""
        asked = self.everybody if wanted is None else wanted
        searched, rows = self._changed(pose, asked)
        self._look_up(rows)
        self.count(int(np.count_nonzero(asked)), searched, len(rows))
        return self.index

    def champions(self, pose: Pose, chosen: tuple[np.ndarray, np.ndarray]) -> Int[np.ndarray, "m"]:
        """Index of the nearest point of the tree to each moved point that is chosen, or any nearer than all choosers.

        Cheaper than ``nearest``, and as good for what is mutual; see ``kernels/cpu_mutual.py``.

        Parameters
        ----------
        chosen: which of the ``m`` each point of the tree chooses, and how far off it is, ``(n,)`` each.
        """
        from bbr_layer.kernels import cpu_mutual, cpu_walk  # only where they are used: Numba takes long to load

        held = cpu_mutual.champions(*chosen, len(self.moving))
        lists = cpu_walk.Lists(*self.tree.lists())
        asked, searched, rows = cpu_mutual.contest(lists, self.moving, pose, held, self._memory())
        self._look_up(rows)
        self.count(asked, searched, len(rows))
        return self.index

    def count(self, asked: int, searched: int, looked_up: int) -> None:
        """Add to what was asked, searched for and looked up."""
        self.asked += int(asked)
        self.searched += int(searched)
        self.looked_up += int(looked_up)

    def tables(self) -> tuple:
        """Everything that compiled code reads and writes: lists, moving points, all of them wanted, memory."""
        if self._tables is None:
            from bbr_layer.kernels import cpu_walk

            self._tables = cpu_walk.Lists(*self.tree.lists()), self.moving, self.everybody, self._memory()
        return self._tables

    def _memory(self) -> "Memory":
        from bbr_layer.kernels import cpu_walk

        return cpu_walk.Memory(self.index, self.reach, self.places, self.distance)

    def _look_up(self, rows: Int[np.ndarray, "k"]) -> None:
        """Search the tree for the neighbours of moved points, at their places."""
        if len(rows):
            at = self.places[rows, : self.tree.points.shape[1]]
            self.index[rows], self.distance[rows], self.reach[rows] = self.tree.nearest(at)

    def _changed(self, pose: Pose, wanted: np.ndarray) -> tuple[int, Int[np.ndarray, "k"]]:
        """How many of the wanted neighbours may have changed, and the rows of those, in their places, to look up."""
        if self.kept and COMPILED and self.searched:
            from bbr_layer.kernels import cpu_walk

            return cpu_walk.refresh(cpu_walk.Lists(*self.tree.lists()), self.moving, pose, wanted, self._memory())
        at = _moved(pose, self.moving)
        if self.kept:
            moved = np.sqrt(squared_length(at - self.places))
            own = np.sqrt(squared_length(at - in_space(self.tree.points.take(self.index, axis=0))))
            wanted = wanted & ~((own + moved) * (1 + ROUNDING) < self.reach)
        rows = np.flatnonzero(wanted)
        self.places[rows] = at[rows]
        return len(rows), rows


class MutualMargins:
    """Mutual nearest neighbours of two clouds on the CPU, float64.

    Parameters
    ----------
    P, Q: trees over the two clouds.
    kept: False looks everything up at every asking.

    Attributes
    ----------
    small: whether compiled code searches on its own, without a tree.
    """

    def __init__(self, P: Tree, Q: Tree, kept: bool):
        self.forth = Margins(P, in_space(Q.points), kept)
        self.back = Margins(Q, in_space(P.points), kept)
        self.small = COMPILED and kept and max(len(P.points), len(Q.points)) <= SMALL

    def __call__(self, pose: Pose) -> tuple[Int[np.ndarray, "m"], Bool[np.ndarray, "m"]]:
        """For each point of Q the nearest of P with Q carried by ``pose``, and whether the choice is mutual.

        The first is valid until the next call. P, carried back, is looked up in Q, and of it only the chosen points.
        """
        if self.small:
            return self._compiled(pose)
        index = self.forth.nearest(pose)
        back = pose[0].T.copy(), -pose[0].T @ pose[1]
        if COMPILED and self.forth.kept and self.back.searched:
            from bbr_layer.kernels import cpu_mutual

            return index, cpu_mutual.agreeing(index, self.back.champions(back, (index, self.forth.distance)))
        chosen = np.zeros(len(self.back.moving), dtype=bool)
        chosen[index] = True
        return index, self.back.nearest(back, chosen)[index] == np.arange(len(index))

    def _compiled(self, pose: Pose) -> tuple[Int[np.ndarray, "m"], Bool[np.ndarray, "m"]]:
        from bbr_layer.kernels import cpu_mutual

        mutual, counts = cpu_mutual.mutual_pairs(self.forth.tables(), self.back.tables(), pose)
        self.count(counts)
        return self.forth.index, mutual

    def count(self, counts: Sequence[Sequence[int]]) -> None:
        """Add to what each side was asked, searched for and looked up."""
        for side, of_side in zip((self.forth, self.back), counts, strict=True):
            side.count(*of_side)


def _moved(pose: Pose, points: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    return points @ pose[0].T + pose[1]
