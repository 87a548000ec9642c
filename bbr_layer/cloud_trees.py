"""One KD-tree per cloud, whoever asks: spacing, normals, starts and every stage search the same points."""

import numpy as np
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from bbr_layer.trees import Tree

# Of every tensor that is searched, the trees of its items.
_KNOWN: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def tree_of(points: Tensor, number: int) -> Tree:
    """The tree over item ``number`` of ``points (batch, n, d)``, on the CPU; kept while the tensor lives unchanged.

    The numbers themselves are compared: what is written through numpy or ``.data`` is counted nowhere.
    """
    item, trees = points[number].detach().double().numpy(), _KNOWN.setdefault(points, {})
    known = trees.get(number)
    if known is None or not np.array_equal(known.points, item):
        known = trees[number] = Tree(item.copy())
    return known
