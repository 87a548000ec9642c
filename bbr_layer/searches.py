"""One search for mutual neighbours per pair of clouds: the loss, its normal equations and the verdict ask the same."""

import weakref
from typing import NamedTuple

from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from bbr_layer.neighbours import MutualNeighbours
from bbr_layer.pair import CloudPair


class _Known(NamedTuple):
    """A search, and the clouds and masks that it was made for: held weakly, and how often each was written to."""

    tensors: list[weakref.ref | None]
    versions: list[int | None]
    search: MutualNeighbours


# By source.
_KNOWN: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def search_of(pair: CloudPair) -> MutualNeighbours:
    """The search of a pair of clouds; one for all who ask, while their tensors live and are not written to."""
    tensors = pair.P, pair.Q, pair.P_mask, pair.Q_mask
    if any(x is not None and x.is_inference() for x in tensors):  # counts no writing
        return MutualNeighbours(*tensors)
    known = _KNOWN.get(pair.Q)
    if known is None or known.versions != _versions(tensors) or not _same(tensors, known.tensors):
        held = [None if x is None else weakref.ref(x) for x in tensors]
        known = _Known(held, _versions(tensors), MutualNeighbours(*tensors))
        _KNOWN[pair.Q] = known
    return known.search


def _versions(tensors: tuple[Tensor | None, ...]) -> list[int | None]:
    return [None if x is None else x._version for x in tensors]


def _same(tensors: tuple[Tensor | None, ...], held: list[weakref.ref | None]) -> bool:
    return all(x is (None if ref is None else ref()) for x, ref in zip(tensors, held, strict=True))
