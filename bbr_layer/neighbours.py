"""Who is nearest to whom: exact nearest and mutual nearest neighbours. Indices only, never a gradient."""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.margins import Margins, MutualMargins, Pose
from bbr_layer.trees import Tree, in_space

# Pairs per tile of the brute-force search on accelerators: 2^24 float32 distances are 64 MiB.
PAIRS_PER_TILE = 2**24


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
        clouds = zip(_real(P.detach(), self.P_rows), _real(Q.detach(), self.Q_rows), strict=True)
        self.shape, self.device = Q.shape[:2], Q.device
        # None where a cloud has no real point.
        self.items: list[MutualMargins | _Tiled | None] = [self._item(p, q, margins) for p, q in clouds]

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
        if self.device.type == "cpu":
            rotation = in_space(in_space(motion.rotation.double().numpy()).swapaxes(1, 2)).swapaxes(1, 2)
            translation = in_space(motion.translation.double().numpy())
            found = [self.of_item(b, pose) for b, pose in enumerate(zip(rotation, translation, strict=True))]
            tables = [(torch.from_numpy(index), torch.from_numpy(mutual)) for index, mutual in found]
        else:
            tables = [self._tiled(b, motion.item(b)) for b in range(len(self.items))]
        nearest = torch.zeros(self.shape, dtype=torch.int64, device=self.device)
        mutual = nearest.bool()
        for b, (index, both) in enumerate(tables):
            nearest[b], mutual[b] = index, both
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

    def _tiled(self, number: int, motion: RigidMotion) -> tuple[Tensor, Tensor]:
        item, P_rows, Q_rows = self.items[number], self.P_rows[number], self.Q_rows[number]
        nearest = torch.zeros(self.shape[1], dtype=torch.int64, device=self.device)
        mutual = nearest.bool()
        if isinstance(item, _Tiled):
            index, both = item(motion)
            rows = slice(None) if Q_rows is None else torch.from_numpy(Q_rows).to(self.device)
            nearest[rows] = index if P_rows is None else torch.from_numpy(P_rows).to(self.device)[index]
            mutual[rows] = both
        return nearest, mutual

    @staticmethod
    def _item(P: Tensor, Q: Tensor, margins: bool) -> "MutualMargins | _Tiled | None":
        if not len(P) or not len(Q):
            return None
        if P.device.type == "cpu":
            return MutualMargins(P.double().numpy(), Q.double().numpy(), margins)
        return _Tiled(P, Q)

    def _sides(self) -> "Iterator[Margins | _Tiled]":
        for item in self.items:
            if isinstance(item, MutualMargins):
                yield from (item.forth, item.back)
            elif item is not None:
                yield item


def _rows(points: Tensor, mask: Tensor | None) -> list[np.ndarray | None]:
    """Each item's rows that are real, None where all are."""
    return [None if mask is None else mask[b].nonzero()[:, 0].cpu().numpy() for b in range(len(points))]


def _real(points: Tensor, rows: list[np.ndarray | None]) -> Iterator[Tensor]:
    """Each item's real points."""
    for item, kept in zip(points, rows, strict=True):
        yield item if kept is None else item[torch.from_numpy(kept).to(item.device)]


class _Tiled:
    """One pair of clouds on an accelerator: explicit differences, a tile of queries at a time."""

    def __init__(self, P: Tensor, Q: Tensor):
        self.P, self.Q = P, Q
        self.asked = self.searched = self.looked_up = 0

    def __call__(self, motion: RigidMotion) -> tuple[Tensor, Tensor]:
        """Indices of the nearest target points and whether the choice is mutual, both ``(m,)``."""
        dtype = motion.translation.dtype
        P, Q = self.P.to(dtype), self.Q.to(dtype)
        index = nearest_by_tiles(motion(Q), P)
        nearest_Q = nearest_by_tiles(motion.inverse()(P), Q)
        self.asked = self.searched = self.looked_up = self.asked + len(P) + len(Q)
        return index, nearest_Q[index] == torch.arange(len(Q), device=Q.device)


def nearest_by_tiles(queries: Float[Tensor, "k d"], points: Float[Tensor, "n d"]) -> Int[Tensor, "k"]:
    """Index of the nearest point for each query, the first of equally near ones."""
    rows = max(1, PAIRS_PER_TILE // len(points))
    return torch.cat([(tile[:, None, :] - points).square().sum(-1).argmin(1) for tile in queries.split(rows)])


def nearest_neighbours(
    points: Float[Tensor, "batch n d"],
    count: int,
    mask: Bool[Tensor, "batch n"] | None = None,
) -> Int[Tensor, "batch n k"]:
    """The ``count`` nearest points of each point within its own cloud, itself first, ``(batch, n, count)``.

    Where a cloud has fewer real points than ``count``, the last ones found are repeated. Padded points get
    neighbours like any other (their rows mean nothing).
    """
    points = points.detach()
    everything = torch.ones_like(points[..., 0], dtype=torch.bool) if mask is None else mask
    found = [neighbours_of(item, item[real], count) for item, real in zip(points, everything, strict=True)]
    kept = [real.nonzero()[:, 0] for real in everything]
    return torch.stack([i if not len(k) else k[i] for i, k in zip(found, kept, strict=True)])


def neighbours_of(queries: Float[Tensor, "k d"], points: Float[Tensor, "n d"], count: int) -> Int[Tensor, "k count"]:
    """The ``count`` nearest of ``points`` for each query, near to far, in any number of dimensions.

    Where there are fewer points than ``count`` the last ones found are repeated; without any, the indices are 0.
    """
    if not len(points):
        return torch.zeros(len(queries), count, dtype=torch.int64, device=points.device)
    searched, asked = points.detach().cpu().double().numpy(), queries.detach().cpu().double().numpy()
    enough = min(count, len(points))
    if points.shape[1] in (2, 3):
        index = Tree(searched).candidates(asked, enough)[1]
    else:
        index = cKDTree(searched).query(asked, k=list(range(1, enough + 1)))[1]
    return torch.from_numpy(np.pad(index, ((0, 0), (0, count - enough)), mode="edge")).to(points.device)
