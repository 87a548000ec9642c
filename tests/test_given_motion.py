"""Poses that came with the scans hold where scans share nothing, and no stronger than they proved elsewhere."""

import dataclasses
import functools

import numpy as np
import pytest
import scipy.stats
import torch
from small_worlds import true_edges, true_poses, world_of

from bbr_layer import RigidMotion
from train.config import EdgeConfig
from train.edges import register_edges
from train.given_motion import FAR, GIVEN, RIGHT_TO, clear, with_given, without_given
from train.scans import ScanSet
from train.simulate import WorldSettings

SCANS, CARRIED = 20, 10


@functools.cache
def _carried() -> ScanSet:
    """A sensor that after ten scans is carried to the far side of the building, its odometry going on: scans 9 and 10
    share nothing."""
    world = world_of(WorldSettings(scans=48, beams=180, seed=1))
    kept = [*range(CARRIED), *range(20, 20 + SCANS - CARRIED)]
    truth, points = world.truth[kept], [world.points[number] for number in kept]
    random = np.random.default_rng(0)
    walked = [truth[0]]
    for before, after in zip(truth[:-1], truth[1:], strict=True):
        slip = RigidMotion.from_rotvec(
            torch.from_numpy(random.normal(0, 0.02, 1)), torch.from_numpy(random.normal(0, 0.02, 2))
        )
        walked.append(walked[-1] @ np.linalg.inv(before) @ after @ slip.matrix.numpy())
    names = [str(number) for number in range(SCANS)]
    return ScanSet(points, names, np.arange(SCANS, dtype=float), start=np.stack(walked), truth=truth)


def _off(poses: RigidMotion) -> np.ndarray:
    return (poses.translation - true_poses(_carried()).translation).norm(dim=-1).numpy()


def test_scans_that_share_nothing_are_joined_by_their_odometry(monkeypatch):
    scans = _carried()
    with monkeypatch.context() as given:
        given.setattr("train.edges.recognised", lambda *_: pytest.fail("loops from no poses, where poses were given"))
        edges, poses = register_edges(scans, EdgeConfig())
    assert GIVEN not in edges.kind.tolist()
    assert not ((edges.target < CARRIED) & (edges.source >= CARRIED)).any(), "found between scans that share nothing"
    drift = np.linalg.norm(scans.start[:, :2, 2] - scans.truth[:, :2, 2], axis=1)
    assert _off(poses)[:CARRIED].max() < 0.05 < drift[CARRIED - 1]
    assert _off(poses).max() < 0.3, "one step of odometry, and its turn over the way"
    alone = dataclasses.replace(scans, start=None)
    assert _off(register_edges(alone, EdgeConfig())[1])[CARRIED:].max() > 1.0


def test_given_motions_pull_as_their_scatter_about_the_good_edges_tells():
    scans = _carried()
    chain = true_edges(scans)
    chain = chain.kept(chain.kind == 0)
    chain = chain._replace(
        information=1e9 * chain.information, score=torch.tensor([0.8, 0.6] * ((SCANS - 1) // 2) + [0.8]).double()
    )
    both = with_given(chain, scans, spacing=0.1)
    assert len(both.score) == 2 * len(chain.score) and (both.kind[len(chain.kind) :] == GIVEN).all()
    walked, truth = (np.linalg.inv(poses[:-1]) @ poses[1:] for poses in (scans.start, scans.truth))
    slips = np.arctan2(walked[:, 1, 0], walked[:, 0, 0]) - np.arctan2(truth[:, 1, 0], truth[:, 0, 0])
    good = np.sort(np.abs(slips[::2]))  # the better half of the chain, by its scores
    deviation = good[(len(good) - 1) // 2] / scipy.stats.norm.ppf(0.75)
    assert both.information[-1, 0, 0].item() == pytest.approx((RIGHT_TO * 0.1 / deviation) ** 2, rel=1e-3)
    # exact poses pull no more than a registered edge
    exact = dataclasses.replace(scans, start=scans.truth)
    torch.testing.assert_close(with_given(chain, exact, 0.1).information[-1], chain.information[0])


def test_edges_that_found_nothing_leave_and_given_ones_are_told_apart():
    scans = _carried()
    chain = true_edges(scans)
    chain = chain.kept(chain.kind == 0)._replace(score=torch.linspace(0, 1, SCANS - 1).double())
    assert clear(chain, chain).score.min() >= 0.3 * 0.5
    assert len(clear(chain, chain).score) == SCANS - 1 - 3
    both = with_given(chain, scans, 0.1)
    belief = torch.arange(len(both.score)).double()
    registered, theirs = without_given(both, belief)
    assert (registered.kind == 0).all() and theirs.tolist() == list(range(SCANS - 1 - 3))


@pytest.mark.parametrize(("score", "deviations", "kept"), [(0.5, 2 * FAR, False), (0.8, 2 * FAR, True), (0.5, 1, True)])
def test_an_edge_far_from_the_given_motion_stays_only_where_it_scores_well(score, deviations, kept):
    scans, lost = _carried(), 4
    chain = true_edges(scans)
    chain = chain.kept(chain.kind == 0)
    scores = torch.full_like(chain.score, 0.6)
    scores[[0, 2, 6, 8, 10, 12, 14, 16, 18]] = 0.8
    scores[lost] = score
    slips = 0.02 * deviations  # radians; the odometry's own slips have this deviation
    start = RigidMotion.from_matrix(torch.from_numpy(scans.start))
    given = start.between(lost, lost + 1)
    turn = RigidMotion.from_rotvec(torch.tensor([[slips]]).double(), torch.zeros(1, 2).double())
    chain.target_from_source.rotation[lost] = turn.rotation[0] @ given.rotation
    chain.target_from_source.translation[lost] = given.translation
    both = with_given(chain._replace(score=scores), scans, spacing=0.1)
    found, _ = without_given(both, torch.ones(len(both.target)))
    assert (lost in found.target.tolist()) == kept
    assert len(found.target) == SCANS - 1 - (not kept), "the others stay"
