"""Groups of padded scans: what they hold, what is held out of them, and that a draw can be repeated."""

import dataclasses

import numpy as np
import pytest
import torch
from small_worlds import small_config, small_world, true_edges, true_poses

from train.data_module import Epoch, MappingData, draw


def data_of(scans, seed=0, **training):
    config = small_config(**training)
    return MappingData(scans, true_edges(scans), true_poses(scans), config=config.training, seed=seed)


@pytest.mark.parametrize("dimension", [2, 3])
def test_an_epoch_holds_every_edge_once_with_its_measurement(dimension):
    data = data_of(small_world(dimension))
    poses, seen = data.start, []
    for batch in Epoch(data, 0):
        ends = batch.index[batch.edges]
        seen += [tuple(pair) for pair in ends.tolist()]
        measured = poses.item(ends[:, 0]).inverse() @ poses.item(ends[:, 1])
        torch.testing.assert_close(batch.edge_measurement.matrix, measured.matrix)
        torch.testing.assert_close(batch.start.matrix, poses.item(batch.index).matrix)
    wanted = zip(data.edges.target.tolist(), data.edges.source.tolist(), strict=True)
    assert sorted(seen) == sorted(wanted)


def test_scans_of_unequal_length_are_padded_and_masked():
    scans = small_world()
    ragged = dataclasses.replace(scans, points=[points[: 20 + 5 * i] for i, points in enumerate(scans.points)])
    data = data_of(ragged)
    for batch in data.every_scan():
        for row, number in enumerate(batch.index.tolist()):
            prepared = data.prepared[number]
            assert int(batch.mask[row].sum()) == len(prepared.trained)
            torch.testing.assert_close(batch.points[row][batch.mask[row]], prepared.points[prepared.trained])
            assert not batch.points[row][~batch.mask[row]].any()


def test_held_out_points_are_never_drawn():
    scans = small_world()
    data = data_of(scans)
    held_out = {tuple(point) for scan in data.prepared for point in scan.points[scan.held_out].tolist()}
    drawn = {tuple(point) for batch in Epoch(data, 0) for point in batch.points[batch.mask].tolist()}
    assert len(held_out) == 8 * 8 and len(drawn) > 400
    assert not held_out & drawn


def drawn(data, epoch):
    return [(batch.index.tolist(), batch.points) for batch in Epoch(data, epoch)]


def test_a_draw_depends_on_seed_and_epoch_alone():
    data = data_of(small_world(), points=20)
    first = drawn(data, 3)
    drawn(data, 0)
    for (index, points), (same_index, same_points) in zip(first, drawn(data, 3), strict=True):
        assert index == same_index and torch.equal(points, same_points)
    assert any(not torch.equal(a[1], b[1]) for a, b in zip(first, drawn(data, 4), strict=True))
    other = data_of(small_world(), seed=1, points=20)
    assert any(not torch.equal(a[1], b[1]) for a, b in zip(first, drawn(other, 3), strict=True))


def test_draws_keep_the_order_of_the_rays(rng):
    assert (np.diff(draw(50, 20, rng)) > 0).all()
    assert draw(50, 5, None).tolist() == [0, 12, 24, 37, 49]
    assert draw(5, 20, rng).tolist() == [0, 1, 2, 3, 4]
