"""Who is nearest to whom: exact nearest and mutual nearest neighbours. Indices only, never a gradient."""

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer.geometry import RigidMotion

# Pairs per tile of the brute-force search on accelerators: 2^24 float32 distances are 64 MiB.
PAIRS_PER_TILE = 2**24


class MutualNeighbours:
    """Mutual nearest neighbours between a fixed target and a rigidly moving source.

    A rigid motion keeps distances, so two KD-trees built once serve every pose: the moved source is looked up in the
    target's tree, and the target, carried back, in the source's tree. On an accelerator the same answer comes from
    tiled brute force.

    Parameters
    ----------
    P, Q: ``(batch, n, d)`` target and ``(batch, m, d)`` source before any motion.
    P_mask, Q_mask: ``(batch, n)`` and ``(batch, m)``, True where a point is real.
    """

    def __init__(
        self,
        P: Float[Tensor, "batch n d"],
        Q: Float[Tensor, "batch m d"],
        P_mask: Bool[Tensor, "batch n"] | None = None,
        Q_mask: Bool[Tensor, "batch m"] | None = None,
    ):
        self.P, self.Q = P.detach(), Q.detach()
        self.P_mask, self.Q_mask = P_mask, Q_mask
        on_cpu = P.device.type == "cpu"
        self.P_search = [_Tree(p, k) if on_cpu else _Tiles(p, k) for p, k in _items(self.P, P_mask)]
        self.Q_search = [_Tree(q, k) if on_cpu else _Tiles(q, k) for q, k in _items(self.Q, Q_mask)]

    def __call__(self, motion: RigidMotion) -> tuple[Int[Tensor, "batch m"], Bool[Tensor, "batch m"]]:
        """For each source point the index of its nearest target point, and whether the choice is mutual.

        Parameters
        ----------
        motion: ``target_from_source`` of the moment, one per batch item.
        """
        if not self.P_search:
            empty = torch.zeros(self.Q.shape[:2], dtype=torch.int64, device=self.Q.device)
            return empty, empty.bool()
        motion = motion.detach()
        forth = motion(self.Q.to(motion.translation.dtype))
        back = motion.inverse()(self.P.to(motion.translation.dtype))
        nearest_P = torch.stack([s.nearest(q) for s, q in zip(self.P_search, forth, strict=True)])
        nearest_Q = torch.stack([s.nearest(p) for s, p in zip(self.Q_search, back, strict=True)])
        own = torch.arange(self.Q.shape[1], device=self.Q.device)
        mutual = nearest_Q.gather(1, nearest_P) == own
        if self.Q_mask is not None:
            mutual = mutual & self.Q_mask
        if self.P_mask is not None:
            mutual = mutual & self.P_mask.gather(1, nearest_P)
        return nearest_P, mutual


def _items(points: Tensor, mask: Tensor | None) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Each item's points with the indices of its real ones (None when all are)."""
    for item in range(points.shape[0]):
        yield points[item], None if mask is None else mask[item].nonzero()[:, 0]


class _Tree:
    """KD-tree over the real points of one cloud; look-ups in float64."""

    def __init__(self, points: Tensor, kept: Tensor | None):
        self.kept = kept
        real = points if kept is None else points[kept]
        self.tree = cKDTree(real.double().numpy()) if real.shape[0] else None

    def nearest(self, queries: Tensor) -> Tensor:
        """Index of the nearest real point for each query ``(k, d)``; 0 where the cloud has none."""
        if self.tree is None:
            return torch.zeros(queries.shape[0], dtype=torch.int64)
        index = torch.from_numpy(self.tree.query(queries.double().numpy())[1])
        return index if self.kept is None else self.kept[index]


class _Tiles:
    """The same look-up by explicit differences, a tile of queries at a time."""

    def __init__(self, points: Tensor, kept: Tensor | None):
        self.kept = kept
        self.real = points if kept is None else points[kept]

    def nearest(self, queries: Tensor) -> Tensor:
        """Index of the nearest real point for each query ``(k, d)``; 0 where the cloud has none."""
        if not self.real.shape[0]:
            return torch.zeros(queries.shape[0], dtype=torch.int64, device=queries.device)
        real = self.real.to(queries.dtype)
        rows = max(1, PAIRS_PER_TILE // real.shape[0])
        tiles = [(tile[:, None, :] - real).square().sum(-1).argmin(1) for tile in queries.split(rows)]
        index = torch.cat(tiles)
        return index if self.kept is None else self.kept[index]


def nearest_neighbours(
    points: Float[Tensor, "batch n d"], count: int, mask: Bool[Tensor, "batch n"] | None = None
) -> Int[Tensor, "batch n k"]:
    """The ``count`` nearest points of each point within its own cloud, itself first, ``(batch, n, count)``.

    Where a cloud has fewer real points than ``count``, the last ones found are repeated. Padded points get
    neighbours like any other (their rows mean nothing).
    """
    found = []
    for item, kept in _items(points.detach().cpu(), None if mask is None else mask.cpu()):
        real = item if kept is None else item[kept]
        if not real.shape[0]:
            found.append(torch.zeros(item.shape[0], count, dtype=torch.int64))
            continue
        k = min(count, real.shape[0])
        ranks = [min(rank, k) for rank in range(1, count + 1)]
        index = torch.from_numpy(cKDTree(real.double().numpy()).query(item.double().numpy(), k=ranks)[1])
        found.append(index if kept is None else kept[index])
    return torch.stack(found).to(points.device)
