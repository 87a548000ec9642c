"""Motions that bring a cloud to the same place, and the starts of which one stands for several."""

import math

import pytest
import torch
from problems import bumpy, motion

from bbr_layer import BBRLayer, CloudPair, Detached, RigidMotion, Stage
from bbr_layer.alike import ALIKE, leaders, moved_little
from bbr_layer.preparation import prepared


def _tables(rows: list[str]) -> torch.Tensor:
    """A batch of one from rows of 0 and 1."""
    return torch.tensor([[[mark == "1" for mark in row] for row in rows]])


@pytest.mark.parametrize(
    ("alike", "wanted"),
    [
        (["1"], [0]),
        (["111", "111", "111"], [0, 0, 0]),
        (["100", "010", "001"], [0, 1, 2]),
        (["110", "111", "011"], [0, 0, 2]),  # 2 is like 1 alone, and 1 follows 0
        (["1010", "0101", "1010", "0101"], [0, 1, 0, 1]),
        (["000", "000", "000"], [0, 1, 2]),  # not even like itself: not finite
    ],
)
def test_each_follows_the_first_that_follows_nobody(alike, wanted):
    assert leaders(_tables(alike)).tolist() == [wanted]


def test_items_do_not_meddle():
    both = torch.cat((_tables(["11", "11"]), _tables(["10", "01"])))
    assert leaders(both).tolist() == [[0, 0], [0, 1]]


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("kind", ["turn", "shift"])
def test_little_is_a_share_of_the_point_spacing_at_the_rim(d, kind):
    P = bumpy(80, d)
    _, pair = prepared(CloudPair(P[None], P[None]), True, False)
    spacing, radius = pair.known_spacing().item(), math.sqrt(pair.Q.square().sum(-1).mean())
    for share, wanted in ((0.9, True), (1.1, False)):
        away = share * ALIKE * spacing
        off = motion(d, away / radius, 0.0) if kind == "turn" else RigidMotion.identity(d, (1,))
        if kind == "shift":
            off = RigidMotion(off.rotation, torch.eye(d, dtype=torch.float64)[:1] * away)
        assert moved_little(RigidMotion.identity(d, (1,)), off, pair).item() is wanted


@pytest.mark.parametrize("degrees", [20, 90])
def test_one_goes_on_for_all_and_the_answer_is_that_of_all_going_on(degrees, monkeypatch):
    torch.manual_seed(1)
    P = torch.stack([bumpy(150, 3), bumpy(150, 3)])
    Q = motion(3, math.radians(degrees)).inverse()(P) + 0.01 * torch.randn_like(P)
    seen = []
    forward = Stage.forward

    def spy(stage, pair, *rest, **named):
        seen.append(len(pair.P))
        return forward(stage, pair, *rest, **named)

    monkeypatch.setattr("bbr_layer.stage.Stage.forward", spy)
    found = BBRLayer.robust(Detached())(P, Q).target_from_source.matrix
    assert seen[0] == 14 and 2 <= seen[1] < 14
    monkeypatch.setattr("bbr_layer.starts.leaders", lambda alike: torch.arange(7).expand(alike.shape[:2]))
    torch.testing.assert_close(BBRLayer.robust(Detached())(P, Q).target_from_source.matrix, found)
