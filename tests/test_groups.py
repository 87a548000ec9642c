"""Groups: every scan and every edge has its place, and no step is crowded."""

import numpy as np
import pytest

from train.groups import CROWDED, group_edges


def edges_of(scans, window, loops, rng):
    pairs = [(i, j) for i in range(scans) for j in range(i + 1, min(i + 1 + window, scans))]
    pairs += [tuple(pair) for pair in rng.integers(scans, size=(loops, 2)) if pair[0] != pair[1]]
    return np.array(pairs).T


@pytest.mark.parametrize(("scans", "size", "loops"), [(20, 8, 0), (20, 8, 60), (7, 2, 20), (3, 8, 2), (33, 4, 300)])
def test_every_edge_is_in_one_group_with_both_ends(rng, scans, size, loops):
    target, source = edges_of(scans, 3, loops, rng)
    groups = group_edges(target, source, scans, size)
    placed = np.concatenate([group.edges for group in groups])
    assert sorted(placed.tolist()) == list(range(len(target)))
    for group in groups:
        assert set(target[group.edges]) | set(source[group.edges]) <= set(group.scans.tolist())
        assert (np.diff(group.scans) > 0).all()
        assert len(group.scans) <= CROWDED * size


def test_every_scan_is_seen_without_any_edge():
    groups = group_edges(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), 10, 4)
    assert [group.scans.tolist() for group in groups] == [[0, 1, 2, 3], [4, 5, 6, 7], [8, 9]]


def test_far_loops_are_put_aside_first():
    target = np.array([0, 1, 2, 3, 9])
    source = np.array([10, 10, 11, 11, 10])
    groups = group_edges(target, source, 12, 2)
    last = [group for group in groups if 10 in group.scans or 11 in group.scans]
    assert last[0].edges.tolist() == [3, 4]
    assert [edge for group in last[1:] for edge in group.edges] == [1, 2, 0] or len(last) > 1


@pytest.mark.parametrize(("size", "target", "words"), [(1, 0, "size is 1"), (4, 12, "the edges name scan 12")])
def test_what_makes_no_group(size, target, words):
    with pytest.raises(ValueError, match=words):
        group_edges(np.array([target]), np.array([1]), 12, size)
