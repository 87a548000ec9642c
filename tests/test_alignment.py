"""The score that judges poses without truth: lowest at the truth, blind to outliers and to where the world begins."""

import dataclasses

import numpy as np
import pytest
import torch
from small_worlds import displaced, small_world, true_edges, true_poses

from bbr_layer import RigidMotion
from train.alignment import EDGE_WEIGHT, Alignment, outlier
from train.data_module import prepare_scan


@pytest.fixture(params=[2, 3])
def scans(request):
    return small_world(request.param)


def score_of(scans, edges):
    return Alignment([prepare_scan(points, 64) for points in scans.points], edges)


def test_the_truth_scores_best_and_farther_is_worse(scans):
    score, poses = score_of(scans, true_edges(scans)), true_poses(scans)
    shift = torch.randn(poses.translation.shape, dtype=torch.float64)
    values = [score(RigidMotion(poses.rotation, poses.translation + far * shift)) for far in (0, 0.02, 0.1, 0.5)]
    assert sorted(values) == values
    assert 0 <= values[0] < values[-1] < 1 + EDGE_WEIGHT


def test_moving_the_world_changes_nothing(scans):
    score, poses = score_of(scans, true_edges(scans)), displaced(true_poses(scans), 0.1)
    turn = torch.tensor([0.7] if scans.dimension == 2 else [0.7, -0.2, 0.3], dtype=torch.float64)
    motion = RigidMotion.from_rotvec(turn, torch.full((scans.dimension,), 30.0, dtype=torch.float64))
    assert score(motion @ poses) == pytest.approx(score(poses), abs=1e-9)


def test_an_edge_without_weight_is_not_asked():
    scans = small_world()
    edges, poses = true_edges(scans), displaced(true_poses(scans), 0.1)
    weight = torch.ones_like(edges.score)
    weight[3] = 0
    kept = torch.arange(len(weight)) != 3
    assert score_of(scans, edges._replace(score=weight))(poses) == pytest.approx(
        score_of(scans, edges.kept(kept))(poses), abs=1e-12
    )


def test_outliers_cost_no_more_the_farther_they_are():
    scans = small_world()
    values = []
    for far in (100.0, 1000.0):
        points = [scan.copy() for scan in scans.points]
        points[2][4::8] += far  # the held-out points of one scan
        spoiled = dataclasses.replace(scans, points=points)
        values.append(score_of(spoiled, true_edges(spoiled)._replace(centre=None))(true_poses(scans)))
    assert values[0] == pytest.approx(values[1], rel=1e-3)


def test_the_kernel():
    np.testing.assert_allclose(outlier(np.array([0.0, 1.0, 3.0, 1e12])), [0, 0.5, 0.75, 1])


@pytest.mark.parametrize("dimension", [2, 3])
def test_edges_that_the_poses_meet_cost_nothing_either_way_round(dimension, monkeypatch):
    scans = small_world(dimension)
    score, poses = score_of(scans, true_edges(scans)), true_poses(scans)
    whole = score(poses)
    monkeypatch.setattr("train.alignment.EDGE_WEIGHT", 0.0)
    assert score(poses) == pytest.approx(whole, abs=1e-9)
