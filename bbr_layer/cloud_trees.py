"""One KD-tree per cloud, whoever asks: spacing, normals, starts and every stage search the same points."""

from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from bbr_layer.trees import Tree

# Of every tensor that is searched: how often it had been written to, and the trees of its items.
_KNOWN: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def tree_of(points: Tensor, number: int) -> Tree:
    """The tree over item ``number`` of ``points (batch, n, d)``, on the CPU; kept while the tensor lives unchanged."""
    item = points[number].detach().double().numpy()
    if points.is_inference():  # counts no writing
        return Tree(item)
    version, trees = _KNOWN.get(points, (None, {}))
    if version != points._version:
        version, trees = points._version, {}
        _KNOWN[points] = version, trees
    if number not in trees:
        trees[number] = Tree(item)
    return trees[number]
