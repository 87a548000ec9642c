"""Which scans are tried as loops: those near each other that look at the same, however far apart in time."""

import numpy as np
import pytest
import torch

from bbr_layer import RigidMotion
from train import loops as module
from train.config import EdgeConfig
from train.loops import apart_in_time, loops
from train.pose_graph import Edges
from train.prepared import prepare
from train.scans import ScanSet, silent
from train.scene import build_scene

RAYS, CONFIG = 90, EdgeConfig()
APART = apart_in_time(CONFIG)


def _look(turn: float, view: float) -> np.ndarray:
    """The walls of a square room, ``view`` radians of it ahead of a sensor in its middle that is turned."""
    angles = np.linspace(-view / 2, view / 2, RAYS) + turn
    rays = np.stack((np.cos(angles), np.sin(angles)), axis=1)
    walls = 3.0 * rays / np.abs(rays).max(axis=1, keepdims=True)
    back = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return walls @ back.T


def _tried(
    turns: list[float], monkeypatch: pytest.MonkeyPatch, views: list[float] | None = None
) -> list[tuple[int, int]]:
    """Pairs that are registered as loops where scans at one place look in these directions, as wide as ``views``."""
    looks = [_look(*look) for look in zip(turns, views or [np.pi] * len(turns), strict=True)]
    scans = ScanSet(looks, [str(i) for i in range(len(turns))], np.arange(len(turns) * 1.0))
    scene = build_scene(scans, prepare(scans, RAYS))
    poses = RigidMotion.from_rotvec(torch.tensor(turns)[:, None].double(), torch.zeros(len(turns), 2).double())
    tried: list[tuple[int, int]] = []

    def registered(scene, pairs, start, kind, *rest, weights):
        tried.extend(zip(pairs[0].tolist(), pairs[1].tolist(), strict=True))
        return _chain(start, pairs)

    monkeypatch.setattr(module, "register_pairs", registered)
    steps = torch.arange(len(turns) - 1)
    chain = _chain(poses.between(steps, steps + 1), (steps, steps + 1))
    loops(scene, poses, chain, CONFIG, silent, weights=None)
    return tried


def _chain(motion: RigidMotion, pairs: tuple[torch.Tensor, torch.Tensor]) -> Edges:
    e = len(pairs[0])
    ones = torch.ones(e, dtype=torch.float64)
    return Edges(*pairs, motion, torch.eye(3).double().expand(e, 3, 3), torch.zeros(e, 2).double(), ones, 0 * ones)


def test_scans_that_look_at_the_same_after_a_while_are_tried(monkeypatch):
    assert _tried([0.0] * (APART + 1), monkeypatch) == [(0, APART)]
    assert _tried([0.0] * APART, monkeypatch) == []


@pytest.mark.parametrize(("turn", "tried"), [(0.25 * np.pi, True), (0.9 * np.pi, False)])
def test_scans_that_look_away_from_each_other_are_not_tried(turn, tried, monkeypatch):
    assert bool(_tried([0.0] * APART + [turn], monkeypatch)) == tried


@pytest.mark.parametrize("order", [1, -1])
def test_a_narrow_scan_and_a_wide_one_are_not_tried_whichever_comes_first(order, monkeypatch):
    views = [2 * np.pi] * APART + [0.5 * np.pi]
    assert _tried([0.0] * (APART + 1), monkeypatch, views[::order]) == []
    assert _tried([0.0] * (APART + 1), monkeypatch, ([2 * np.pi] * APART + [1.5 * np.pi])[::order]) == [(0, APART)]


def test_scans_of_unknown_views_are_tried_however_they_stand(monkeypatch):
    monkeypatch.setattr("train.scene.range_views", lambda scans, thinned: [None] * len(scans))
    assert _tried([0.0] * APART + [0.9 * np.pi], monkeypatch) == [(0, APART)]
