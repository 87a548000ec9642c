"""Who is nearest to whom: exact nearest and mutual nearest neighbours. Indices only, never a gradient."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bbr_layer.cloud_trees import tree_of
from bbr_layer.embedding import matrices_in_space
from bbr_layer.geometry import RigidMotion
from bbr_layer.margins import Margins, MutualMargins, Pose
from bbr_layer.threads import side_by_side
from bbr_layer.tiles import Tiled, nearest_by_tiles
from bbr_layer.trees import Tree, in_space


class MutualNeighbours:
    """Mutual nearest neighbours between a fixed target and a rigidly moving source.

    A rigid motion keeps distances, so two KD-trees built once serve every pose: the moved source is looked up in the
    target's tree, and the target, carried back, in the source's tree; there only those target points that are some
    source point's nearest. Neighbours that cannot have changed since they were found are not looked up again, see
    ``Margins``. On an accelerator the same answer comes from tiled brute force. Of several equally near points the
    first is the nearest.

    Parameters
    ----------
    P, Q: ``(batch, n, d)`` target and ``(batch, m, d)`` source before any motion.
    P_mask, Q_mask: ``(batch, n)`` and ``(batch, m)``, True where a point is real.
    margins: False looks everything up at every motion, for comparison.
    """

    def __init__(
        self,
        P: Float[Tensor, "batch n d"],
        Q: Float[Tensor, "batch m d"],
        P_mask: Bool[Tensor, "batch n"] | None = None,
        Q_mask: Bool[Tensor, "batch m"] | None = None,
        *,
        margins: bool = True,
    ):
        self.P_rows, self.Q_rows = _rows(P, P_mask), _rows(Q, Q_mask)
        self.shape, self.device = Q.shape[:2], Q.device
        # None where a cloud has no real point.
        self.items: list[MutualMargins | Tiled | None] = [self._item(P, Q, b, margins) for b in range(len(P))]

    @property
    def asked(self) -> int:
        """How many neighbours were wanted so far."""
        return sum(side.asked for side in self._sides())

    @property
    def searched(self) -> int:
        """How many of them may have changed since the motion before."""
        return sum(side.searched for side in self._sides())

    @property
    def looked_up(self) -> int:
        """How many of those a whole cloud was searched for."""
        return sum(side.looked_up for side in self._sides())

    def __call__(self, motion: RigidMotion) -> tuple[Int[Tensor, "batch m"], Bool[Tensor, "batch m"]]:
        """For each source point the index of its nearest target point, and whether the choice is mutual.

        Padded source points, and all where the target has no real point, get index 0 and False.

        Parameters
        ----------
        motion: ``target_from_source`` of the moment, one per batch item.
        """
        motion = motion.detach()
        nearest = torch.zeros(self.shape, dtype=torch.int64, device=self.device)
        mutual = nearest.bool()
        if self.device.type == "cpu":
            rotation = matrices_in_space(motion.rotation.double().numpy())
            translation = in_space(motion.translation.double().numpy())
            tables = nearest.numpy(), mutual.numpy()

            def work(b: int) -> None:
                tables[0][b], tables[1][b] = self.of_item(b, (rotation[b], translation[b]))

            side_by_side(work, len(self.items))
        else:
            for b in range(len(self.items)):
                nearest[b], mutual[b] = self._tiled(b, motion.item(b))
        return nearest, mutual

    def of_item(self, number: int, pose: Pose) -> tuple[Int[np.ndarray, "m"], Bool[np.ndarray, "m"]]:
        """The same on the CPU for one item, in numpy, its pose embedded in space; the index lasts until the next call.

        Embedded: a rotation of the plane has zeros, or a one in the corner, where it has no number.
        """
        item, P_rows, Q_rows = self.items[number], self.P_rows[number], self.Q_rows[number]
        nearest, mutual = np.zeros(self.shape[1], dtype=np.int64), np.zeros(self.shape[1], dtype=bool)
        if not isinstance(item, MutualMargins):
            return nearest, mutual
        index, both = item((np.ascontiguousarray(pose[0]), np.ascontiguousarray(pose[1])))
        index = index if P_rows is None else P_rows[index]
        if Q_rows is None:
            return index, both
        nearest[Q_rows], mutual[Q_rows] = index, both
        return nearest, mutual

    def tables(self, number: int) -> tuple | None:
        """What compiled code searches an item with: both sides, and the rows of P and Q; None where it cannot."""
        item = self.items[number]
        if not isinstance(item, MutualMargins) or not item.small:
            return None
        sizes = len(item.back.moving), len(item.forth.moving)
        rows = (self.P_rows[number], self.Q_rows[number])
        real = [np.arange(n) if kept is None else kept for n, kept in zip(sizes, rows, strict=True)]
        return item.forth.tables(), item.back.tables(), *real

    def count(self, number: int, counts: np.ndarray) -> None:
        """Note what compiled code asked of an item, ``(2, 3)``."""
        item = self.items[number]
        if isinstance(item, MutualMargins):
            item.count(counts.tolist())

    def _tiled(self, number: int, motion: RigidMotion) -> tuple[Tensor, Tensor]:
        item, P_rows, Q_rows = self.items[number], self.P_rows[number], self.Q_rows[number]
        nearest = torch.zeros(self.shape[1], dtype=torch.int64, device=self.device)
        mutual = nearest.bool()
        if isinstance(item, Tiled):
            index, both = item(motion)
            rows = slice(None) if Q_rows is None else torch.from_numpy(Q_rows).to(self.device)
            nearest[rows] = index if P_rows is None else torch.from_numpy(P_rows).to(self.device)[index]
            mutual[rows] = both
        return nearest, mutual

    def _item(self, P: Tensor, Q: Tensor, number: int, margins: bool) -> "MutualMargins | Tiled | None":
        sides = (P, self.P_rows[number]), (Q, self.Q_rows[number])
        if not all(points.shape[1] if rows is None else len(rows) for points, rows in sides):
            return None
        if P.device.type == "cpu":
            trees = [_tree(points, number, rows) for points, rows in sides]
            return MutualMargins(trees[0], trees[1], margins)
        clouds = [_real(points.detach()[number], rows) for points, rows in sides]
        return Tiled(clouds[0], clouds[1])

    def _sides(self) -> "Iterator[Margins | Tiled]":
        for item in self.items:
            if isinstance(item, MutualMargins):
                yield from (item.forth, item.back)
            elif item is not None:
                yield item


def nearest_points(
    P: Float[Tensor, "batch n d"], queries: Float[Tensor, "batch k d"], P_mask: Bool[Tensor, "batch n"] | None = None
) -> Int[Tensor, "batch k"]:
    """Index of each query's nearest point of P, one way only; 0 where P has no real point."""
    found = torch.zeros(queries.shape[:2], dtype=torch.int64, device=P.device)
    for number, rows in enumerate(_rows(P, P_mask)):
        if not (P.shape[1] if rows is None else len(rows)):
            continue
        if P.device.type == "cpu":
            index = torch.from_numpy(_tree(P, number, rows).nearest(queries[number].double().numpy())[0])
        else:
            index = nearest_by_tiles(queries[number], _real(P[number], rows).to(queries.dtype))
        found[number] = index if rows is None else torch.from_numpy(rows).to(P.device)[index]
    return found


def _rows(points: Tensor, mask: Tensor | None) -> list[np.ndarray | None]:
    """Each item's rows that are real, None where all are."""
    return [None if mask is None else mask[b].nonzero()[:, 0].cpu().numpy() for b in range(len(points))]


def _real(item: Tensor, rows: np.ndarray | None) -> Tensor:
    """An item's real points."""
    return item if rows is None else item[torch.from_numpy(rows).to(item.device)]


def _tree(points: Tensor, number: int, rows: np.ndarray | None) -> Tree:
    """Over the real points of an item; one for all who ask where that is all of them."""
    return tree_of(points, number) if rows is None else Tree(points[number].detach().double().numpy()[rows])
