"""The nearest points within a cloud itself. Indices only, never a gradient."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bbr_layer.cloud_trees import tree_of
from bbr_layer.trees import LISTED, Tree


def nearest_neighbours(
    points: Float[Tensor, "batch n d"],
    count: int,
    mask: Bool[Tensor, "batch n"] | None = None,
) -> Int[Tensor, "batch n k"]:
    """The ``count`` nearest points of each point within its own cloud, itself first, ``(batch, n, count)``.

    Where a cloud has fewer real points than ``count``, the last ones found are repeated. Padded points get
    neighbours like any other (their rows mean nothing).
    """
    if mask is None and count <= LISTED:
        trees = [known_tree(points, b) for b in range(len(points))]
        if trees and all(trees):
            return torch.stack([listed(tree, count) for tree in trees if tree is not None])
    everything = torch.ones_like(points[..., 0], dtype=torch.bool) if mask is None else mask
    found = [neighbours_of(item, item[real], count) for item, real in zip(points, everything, strict=True)]
    kept = [real.nonzero()[:, 0] for real in everything]
    return torch.stack([i if not len(k) else k[i] for i, k in zip(found, kept, strict=True)])


def listed(tree: Tree, count: int) -> Int[Tensor, "n count"]:
    """The same for all points of a tree, from the lists that it keeps."""
    index = tree.lists()[1][:, :count].astype(np.int64)
    return torch.from_numpy(_filled(index, count))


def known_tree(points: Tensor, number: int) -> Tree | None:
    """The tree over item ``number`` of ``points (batch, n, d)`` that others search too, where there can be one.

    Not where it has dropped duplicates: as neighbours, they count.
    """
    if points.device.type != "cpu" or points.shape[-1] not in (2, 3) or not points.shape[1]:
        return None
    tree = tree_of(points, number)
    return tree if tree.kept is None else None


def neighbours_of(
    queries: Float[Tensor, "k d"], points: Float[Tensor, "n d"], count: int, tree: Tree | None = None
) -> Int[Tensor, "k count"]:
    """The ``count`` nearest of ``points`` for each query, near to far, in any number of dimensions.

    Where there are fewer points than ``count`` the last ones found are repeated; without any, the indices are 0.
    ``tree`` is over the points, where there is one already.
    """
    if not len(points):
        return torch.zeros(len(queries), count, dtype=torch.int64, device=points.device)
    searched, asked = points.detach().cpu().double().numpy(), queries.detach().cpu().double().numpy()
    enough = min(count, len(points))
    if points.shape[1] in (2, 3):
        index = (tree or Tree(searched)).candidates(asked, enough)[1]
    else:
        index = cKDTree(searched).query(asked, k=list(range(1, enough + 1)))[1]
    return torch.from_numpy(_filled(index, count)).to(points.device)


def _filled(index: Int[np.ndarray, "k found"], count: int) -> Int[np.ndarray, "k count"]:
    """Up to ``count`` columns, the last one repeated."""
    missing = count - index.shape[1]
    return np.concatenate((index, *(index[:, -1:],) * missing), axis=1) if missing else index
