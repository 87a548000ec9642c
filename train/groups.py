"""Which scans and edges go through the mapper in one step."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Int

# A step holds at most this many times ``size`` scans, its own and the partners of their edges.
CROWDED = 2


class Group(NamedTuple):
    """One step of the training.

    Parameters
    ----------
    scans: ``(g,)`` numbers of its scans, rising.
    edges: ``(e,)`` numbers of its edges; both ends of each are among the scans.
    """

    scans: Int[np.ndarray, " g"]
    edges: Int[np.ndarray, " e"]


def group_edges(target: Int[np.ndarray, " e"], source: Int[np.ndarray, " e"], scans: int, size: int) -> list[Group]:
    """Cut the sequence into blocks of ``size`` consecutive scans and give every edge to one of them.

    An edge belongs to the block of its later scan; its other end joins the block as a guest. Where the guests would
    crowd a step beyond ``CROWDED * size`` scans, the remaining edges get a step of their own. So every scan and
    every edge has its place, every edge exactly one.

    Parameters
    ----------
    target, source: ``(e,)`` numbers of the scans at both ends.
    scans: how many there are.
    size: at least 2.

    Raises
    ------
    ValueError: a size below 2, or an edge to a scan that does not exist.
    """
    if size < 2:
        raise ValueError(f"size is {size}; an edge needs two scans in its group: try 8")
    ends = np.stack((target, source), axis=1).reshape(-1, 2)
    if ends.size and not (0 <= ends.min() and ends.max() < scans):
        raise ValueError(f"the edges name scan {ends.max()} or {ends.min()}; the scans are 0 to {scans - 1}")
    later, earlier = ends.max(axis=1), ends.min(axis=1)
    groups = []
    for first in range(0, scans, size):
        last = min(first + size, scans)
        own = np.flatnonzero((later >= first) & (later < last))
        # Nearest guests first: the window's edges stay with their block, far loops are the ones put aside.
        own = own[np.argsort(-earlier[own], kind="stable")]
        groups += _fill(range(first, last), own, ends, CROWDED * size)
    return groups


def _fill(block: range, edges: np.ndarray, ends: np.ndarray, most: int) -> list[Group]:
    groups: list[Group] = []
    members, chosen = set(block), list[int]()
    for edge in edges:
        pair = set(ends[edge].tolist())
        if len(members | pair) > most:
            groups.append(_group(members, chosen))
            members, chosen = set(), []
        members |= pair
        chosen.append(int(edge))
    return [*groups, _group(members, chosen)]


def _group(members: set[int], edges: list[int]) -> Group:
    return Group(np.array(sorted(members), dtype=np.int64), np.array(sorted(edges), dtype=np.int64))
