"""Who is nearest to whom: exact nearest and mutual nearest neighbours. Indices only, never a gradient."""

from collections.abc import Iterator
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.margins import Margins
from bbr_layer.trees import Tree

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
        items = zip(_items(P.detach(), P_mask), _items(Q.detach(), Q_mask), strict=True)
        kind = partial(_Remembered, margins=margins) if P.device.type == "cpu" else _Tiled
        self.items: list[_Remembered | _Tiled] = [kind(p, q) for (p, _), (q, _) in items]
        self.P_rows = [kept for _, kept in _items(P, P_mask)]
        self.Q_rows = [kept for _, kept in _items(Q, Q_mask)]
        self.empty = torch.zeros(Q.shape[:2], dtype=torch.int64, device=Q.device)

    @property
    def asked(self) -> int:
        """How many neighbours were wanted so far."""
        return sum(item.asked for item in self.items)

    @property
    def looked_up(self) -> int:
        """How many of them a cloud was searched for."""
        return sum(item.looked_up for item in self.items)

    def __call__(self, motion: RigidMotion) -> tuple[Int[Tensor, "batch m"], Bool[Tensor, "batch m"]]:
        """For each source point the index of its nearest target point, and whether the choice is mutual.

        Padded source points, and all where the target has no real point, get index 0 and False.

        Parameters
        ----------
        motion: ``target_from_source`` of the moment, one per batch item.
        """
        motion = motion.detach()
        nearest, mutual = self.empty.clone(), self.empty.bool()
        for number, (item, P_rows, Q_rows) in enumerate(zip(self.items, self.P_rows, self.Q_rows, strict=True)):
            if not len(item.P) or not len(item.Q):
                continue
            index, both = item(motion.item(number))
            rows = slice(None) if Q_rows is None else Q_rows
            nearest[number, rows] = index if P_rows is None else P_rows[index]
            mutual[number, rows] = both
        return nearest, mutual


def _items(points: Tensor, mask: Tensor | None) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Each item's real points with their indices (None when all are)."""
    for item in range(points.shape[0]):
        kept = None if mask is None else mask[item].nonzero()[:, 0]
        yield points[item] if kept is None else points[item][kept], kept


class _Remembered:
    """One pair of clouds on the CPU: look-ups in float64 trees, and the margins they were found with."""

    def __init__(self, P: Tensor, Q: Tensor, margins: bool):
        self.P, self.Q, self.margins = P.double(), Q.double(), margins
        if len(P) and len(Q):
            self.forth = Margins(Tree(self.P.numpy()), len(Q), margins)
            self.back = Margins(Tree(self.Q.numpy()), len(P), margins)

    @property
    def asked(self) -> int:
        return self.forth.asked + self.back.asked if len(self.P) and len(self.Q) else 0

    @property
    def looked_up(self) -> int:
        return self.forth.looked_up + self.back.looked_up if len(self.P) and len(self.Q) else 0

    def __call__(self, motion: RigidMotion) -> tuple[Tensor, Tensor]:
        """Indices of the nearest target points and whether the choice is mutual, both ``(m,)``."""
        motion = motion.to(torch.float64)
        index = self.forth.nearest(motion(self.Q).numpy())
        chosen = np.zeros(len(self.P), dtype=bool)
        chosen[index] = True
        nearest_Q = self.back.nearest(motion.inverse()(self.P).numpy(), chosen)
        mutual = nearest_Q[index] == np.arange(len(self.Q))
        return torch.from_numpy(index), torch.from_numpy(mutual)


class _Tiled:
    """One pair of clouds on an accelerator: explicit differences, a tile of queries at a time."""

    def __init__(self, P: Tensor, Q: Tensor):
        self.P, self.Q = P, Q
        self.asked = self.looked_up = 0

    def __call__(self, motion: RigidMotion) -> tuple[Tensor, Tensor]:
        """Indices of the nearest target points and whether the choice is mutual, both ``(m,)``."""
        dtype = motion.translation.dtype
        P, Q = self.P.to(dtype), self.Q.to(dtype)
        index = nearest_by_tiles(motion(Q), P)
        nearest_Q = nearest_by_tiles(motion.inverse()(P), Q)
        self.asked, self.looked_up = self.asked + len(P) + len(Q), self.looked_up + len(P) + len(Q)
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
