"""Edges without registration: window and neighbours in space, or a file."""

import pytest
import torch
from small_worlds import SCANS, displaced, small_world, true_edges, true_poses, with_start

from train.config import EdgeConfig
from train.edge_files import save_edges
from train.known_edges import KnownEdges, neighbouring


def pairs(edges):
    return set(zip(edges.target.tolist(), edges.source.tolist(), strict=True))


@pytest.mark.parametrize("dimension", [2, 3])
def test_window_and_neighbours_measured_by_the_poses(dimension):
    scans = small_world(dimension)
    poses = displaced(true_poses(scans), 0.1)
    edges = neighbouring(scans, poses, EdgeConfig(window=2, loops_per_scan=1))
    assert {(i, i + 1) for i in range(SCANS - 1)} | {(i, i + 2) for i in range(SCANS - 2)} <= pairs(edges)
    relative = poses.item(edges.target).inverse() @ poses.item(edges.source)
    torch.testing.assert_close(edges.target_from_source.matrix, relative.matrix)
    later = edges.source - edges.target
    assert (later > 0).all()
    assert torch.equal(edges.kind, torch.where(later == 1, 0, torch.where(later <= 2, 1, 2)))


def test_loops_join_scans_that_stand_close():
    scans = small_world()
    poses = true_poses(scans)
    # A walk there and back: scan 7 stands where scan 0 stood, far from scan 4.
    poses.translation[:, 0] = torch.tensor([0.0, 50, 100, 150, 151, 100, 50, 0])
    poses.translation[:, 1] = 0
    edges = neighbouring(scans, poses, EdgeConfig(window=1, loops_per_scan=4))
    assert {pair for pair in pairs(edges) if pair[1] - pair[0] > 1} == {(0, 7), (1, 6), (2, 5)}
    none = neighbouring(scans, poses, EdgeConfig(window=1, loops_per_scan=0))
    assert len(none.target) == SCANS - 1


def test_a_file_of_edges_goes_with_the_given_poses(tmp_path):
    scans = small_world()
    given = displaced(true_poses(scans), 0.1)
    save_edges(tmp_path / "edges.npz", true_edges(scans), true_poses(scans), scans)
    known = KnownEdges(tmp_path / "edges.npz")
    edges, poses = known(with_start(scans, given), EdgeConfig())
    assert pairs(edges) == pairs(true_edges(scans))
    assert torch.equal(poses.matrix, given.matrix)


def test_the_origin_tells_files_apart(tmp_path):
    scans = small_world()
    for name, metres in (("a", 0.0), ("b", 0.1)):
        save_edges(tmp_path / f"{name}.npz", true_edges(scans), displaced(true_poses(scans), metres), scans)
    origins = {KnownEdges(path).origin for path in (None, tmp_path / "a.npz", tmp_path / "b.npz")}
    assert len(origins) == 3
    with pytest.raises(FileNotFoundError, match="no such file of edges"):
        _ = KnownEdges(tmp_path / "c.npz").origin


def test_scans_without_poses_are_refused():
    with pytest.raises(ValueError, match="came without poses"):
        KnownEdges()(small_world(), EdgeConfig())


def test_of_several_loops_the_nearest_in_space_are_taken():
    poses = true_poses(small_world())
    poses.translation[:, 0] = torch.tensor([0.0, 50, 100, 150, 200, 0.3, 0.1, 0.2])
    poses.translation[:, 1] = 0
    edges = neighbouring(small_world(), poses, EdgeConfig(window=1, loops_per_scan=1))
    assert edges.source[(edges.target == 0) & (edges.kind == 2)].tolist() == [6]
