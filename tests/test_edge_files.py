"""Edges in a file: the same bits again, and what is no such file."""

import pytest
import torch
from small_worlds import SCANS, displaced, small_world, true_edges, true_poses

from train.edge_files import load_edges, save_edges


@pytest.mark.parametrize("dimension", [2, 3])
def test_edges_come_back_to_the_last_bit(tmp_path, dimension):
    scans = small_world(dimension)
    edges, poses = true_edges(scans), displaced(true_poses(scans), 0.1)
    save_edges(tmp_path / "edges.npz", edges, poses)
    found, world_from_scan = load_edges(tmp_path / "edges.npz", SCANS)
    assert torch.equal(world_from_scan.matrix, poses.matrix)
    assert torch.equal(found.target_from_source.matrix, edges.target_from_source.matrix)
    for name in ("target", "source", "information", "centre", "score", "kind"):
        assert torch.equal(getattr(found, name), getattr(edges, name))


def test_what_is_no_file_of_edges(tmp_path):
    path = tmp_path / "edges.npz"
    with pytest.raises(FileNotFoundError, match="no such file of edges"):
        load_edges(path, SCANS)
    scans = small_world()
    save_edges(path, true_edges(scans), true_poses(scans))
    with pytest.raises(ValueError, match="belongs to 8 scans; 9 were given"):
        load_edges(path, 9)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(ValueError, match="no file of edges"):
        load_edges(path, SCANS)
