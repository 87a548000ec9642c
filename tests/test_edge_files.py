"""Edges in a file: the same bits again, and what is no such file."""

import dataclasses

import numpy as np
import pytest
import torch
from small_worlds import displaced, small_world, true_edges, true_poses, with_start

from train.edge_files import load_edges, save_edges
from train.scans import ScanSet


@pytest.mark.parametrize("dimension", [2, 3])
def test_edges_come_back_to_the_last_bit(tmp_path, dimension):
    scans = small_world(dimension)
    edges, poses = true_edges(scans), displaced(true_poses(scans), 0.1)
    save_edges(tmp_path / "edges.npz", edges, poses, scans)
    found, world_from_scan = load_edges(tmp_path / "edges.npz", scans)
    assert torch.equal(world_from_scan.matrix, poses.matrix)
    assert torch.equal(found.target_from_source.matrix, edges.target_from_source.matrix)
    for name in ("target", "source", "information", "centre", "score", "kind"):
        assert torch.equal(getattr(found, name), getattr(edges, name))


def test_edges_of_other_scans_are_refused(tmp_path):
    path, scans = tmp_path / "edges.npz", small_world()
    save_edges(path, true_edges(scans), true_poses(scans), scans)
    with pytest.raises(ValueError, match="belongs to 8 scans in 2D; 8 in 3D were given: name the edges of these"):
        load_edges(path, small_world(3))
    fewer = ScanSet(scans.points[:-1], scans.names[:-1], scans.timestamps[:-1])
    with pytest.raises(ValueError, match="belongs to 8 scans in 2D; 7 in 2D were given"):
        load_edges(path, fewer)
    with pytest.raises(ValueError, match="belongs to other scans, as many as were given"):
        load_edges(path, dataclasses.replace(scans, points=scans.points[::-1]))
    found, _ = load_edges(path, with_start(scans, true_poses(scans)))
    assert torch.equal(found.target_from_source.matrix, true_edges(scans).target_from_source.matrix)


def test_a_file_that_does_not_tell_whose_edges_it_holds_is_believed(tmp_path):
    path, scans = tmp_path / "edges.npz", small_world()
    save_edges(path, true_edges(scans), true_poses(scans), scans)
    with np.load(path) as arrays:
        older = {name: arrays[name] for name in arrays if name != "scans"}
    np.savez(path, **older)
    found, _ = load_edges(path, dataclasses.replace(scans, points=scans.points[::-1]))
    assert torch.equal(found.target_from_source.matrix, true_edges(scans).target_from_source.matrix)


def test_what_is_no_file_of_edges(tmp_path):
    path, scans = tmp_path / "edges.npz", small_world()
    with pytest.raises(FileNotFoundError, match="no such file of edges"):
        load_edges(path, scans)
    np.savez(path, world_from_scan=np.eye(3))
    with pytest.raises(ValueError, match="no file of edges"):
        load_edges(path, scans)


def test_a_damaged_file_of_edges_is_told_wherever_the_damage_is(tmp_path, rng):
    path, scans = tmp_path / "edges.npz", small_world()
    save_edges(path, true_edges(scans), true_poses(scans), scans)
    whole = path.read_bytes()
    flipped = []
    for place in rng.integers(0, len(whole), 100):
        flipped.append(whole[:place] + bytes([whole[place] ^ 1 << rng.integers(8)]) + whole[place + 1 :])
    for damaged in (b"", whole[:200], whole[:-30]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="no file of edges"):
            load_edges(path, scans)
    told = 0
    for damaged in flipped:
        path.write_bytes(damaged)
        try:
            load_edges(path, scans)
        except ValueError as error:
            assert "no file of edges" in str(error)
            told += 1
    assert told > 50, "a few bytes are of no account"
