"""Things that go along with the sensor hide that it moves; its usual speed tells."""

import dataclasses

import numpy as np
import pytest
import torch
from small_worlds import small_world, true_edges, true_poses

from bbr_layer import RigidMotion
from train import edges as edges_file
from train import usual_speed as module
from train.chain import consecutive
from train.config import EdgeConfig
from train.edges import register_edges
from train.prepared import prepare, thinned
from train.scans import ScanSet, silent
from train.scene import build_scene
from train.usual_speed import DIRECTIONS, at_usual_speed

# A corridor along x with a cupboard every few metres, that reach so far to its middle, metres; steps of the sensor,
# rays of a scan.
WIDTH, EVERY, DEEP, STEP, RAYS, SIGHT = 3.0, 2.5, 0.7, 0.4, 240, 9.0
COMPANY = range(9, 12)  # the steps during which others go along
COMPANIONS = ((1.2, 0.6), (1.5, -0.7), (-1.3, 0.6), (-1.0, -0.8))  # where, seen from the sensor


def _walls() -> np.ndarray:
    """Segments ``(n, 2, 2)``: both walls, and cupboards along them at irregular places."""
    rng, segments = np.random.default_rng(0), []
    for side in (-WIDTH / 2, WIDTH / 2):
        segments.append([(-12, side), (40, side)])
        for x in np.arange(-10, 40, EVERY):
            left, inward = x + rng.uniform(0, EVERY / 2), side * DEEP
            right = left + rng.uniform(0.3, 0.8)
            corners = [(left, side), (left, inward), (right, inward), (right, side)]
            segments += [corners[k : k + 2] for k in range(3)]
    return np.array(segments, dtype=float)


def _company() -> np.ndarray:
    """People around the sensor, in its own frame: boxes that hide part of the view."""
    boxes = []
    for x, y in COMPANIONS:
        corners = [(x + dx, y + dy) for dx, dy in ((-0.2, -0.15), (0.2, -0.15), (0.2, 0.15), (-0.2, 0.15))]
        boxes += [[corners[k], corners[(k + 1) % 4]] for k in range(4)]
    return np.array(boxes, dtype=float)


def _hits(segments: np.ndarray) -> np.ndarray:
    """Where rays from the origin first meet a segment, those within sight."""
    angles = np.arange(RAYS) * 2 * np.pi / RAYS + 1e-3
    rays = np.stack((np.cos(angles), np.sin(angles)), 1)[:, None]
    start, along = segments[None, :, 0], (segments[:, 1] - segments[:, 0])[None]
    across = rays[..., 0] * along[..., 1] - rays[..., 1] * along[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (start[..., 0] * along[..., 1] - start[..., 1] * along[..., 0]) / across
        share = (start[..., 0] * rays[..., 1] - start[..., 1] * rays[..., 0]) / across
    far = np.where((far > 0) & (share >= 0) & (share <= 1), far, np.inf).min(axis=1)
    return (rays[:, 0] * far[:, None])[far < SIGHT]


def _walk(steps: list[float], company: range = range(0)) -> ScanSet:
    """Scans at the ends of the steps along the corridor."""
    places = np.concatenate(([0.0], np.cumsum(steps)))
    clouds = []
    for number, x in enumerate(places):
        seen = _walls() - np.array([x, 0.1])
        if number in company or number - 1 in company:
            seen = np.concatenate((seen, _company()))
        clouds.append(_hits(seen))
    truth = np.tile(np.eye(3), (len(places), 1, 1))
    truth[:, 0, 2] = places
    return ScanSet(clouds, [str(k) for k in range(len(places))], np.arange(len(places), dtype=float), truth=truth)


def _steps(count: int) -> list[float]:
    return (STEP + 0.02 * np.random.default_rng(1).standard_normal(count)).tolist()


def _chained(scans: ScanSet):
    scene = build_scene(scans, thinned(prepare(scans, 5000), EdgeConfig().points))
    chain = consecutive(scene, scans, silent)
    return chain, *at_usual_speed(scene, chain)


def _lengths(edges) -> np.ndarray:
    return edges.target_from_source.translation.norm(dim=-1).numpy()


def test_steps_that_company_hides_are_found_by_their_length():
    steps = _steps(20)
    chain, found, replaced = _chained(_walk(steps, COMPANY))
    hidden = np.abs(_lengths(chain) - steps) > 0.2
    assert hidden.any(), "the company must hide some step, or nothing is shown"
    assert set(np.flatnonzero(hidden)) <= set(np.flatnonzero(replaced.numpy()))
    assert np.abs(found.target_from_source.translation[:, 0].numpy() - steps).max() < 0.1
    assert torch.equal(found.target_from_source.translation[~replaced], chain.target_from_source.translation[~replaced])
    assert found.target.tolist() == list(range(20)) and found.source.tolist() == list(range(1, 21))


def test_the_map_is_right_though_others_go_along():
    scans = _walk(_steps(20), COMPANY)
    _, poses = register_edges(scans, EdgeConfig())
    assert (poses.translation - true_poses(scans).translation).norm(dim=-1).max() < 0.02


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_a_sensor_that_stood_is_left_where_it_stood(noise):
    steps, random = _steps(20), np.random.default_rng(3)
    steps[8] = steps[9] = 0.0
    scans = _walk(steps)
    scans = dataclasses.replace(scans, points=[x + noise * random.standard_normal(x.shape) for x in scans.points])
    chain, found, replaced = _chained(scans)
    assert not replaced.any() and torch.equal(found.score, chain.score)
    np.testing.assert_allclose(_lengths(found)[8:10], 0.0, atol=0.01)


def test_where_every_step_is_another_there_is_no_usual_length():
    steps = np.random.default_rng(2).uniform(0.0, 0.8, 20).tolist()
    _, _, replaced = _chained(_walk(steps))
    assert not replaced.any()


@pytest.mark.parametrize("count", [1, 2])
def test_a_few_scans_have_a_usual_speed_too(count):
    chain, found, replaced = _chained(_walk(_steps(count)))
    assert not replaced.any() and len(found.target) == len(chain.target) == count


def _steps_of(lengths: list[float]):
    """A chain of steps along x, of a score as people give."""
    chain = true_edges(small_world()).kept(torch.zeros(len(lengths), dtype=torch.long))
    shifts = torch.tensor([[length, 0.0] for length in lengths], dtype=torch.float64)
    motion = RigidMotion(torch.eye(2, dtype=torch.float64).expand(len(lengths), 2, 2), shifts)
    return chain._replace(target_from_source=motion, score=torch.full((len(lengths),), 0.5, dtype=torch.float64))


def _small_scene():
    return build_scene(small_world(), thinned(prepare(small_world(), 100), 100))


def test_steps_that_differ_by_rounding_alone_are_not_sought_again(monkeypatch):
    def refused(*_):
        raise AssertionError("sought again")

    monkeypatch.setattr("train.usual_speed._in_all_directions", refused)
    chain = _steps_of([1.0] * 9 + [1.0 + 1e-9])
    found, replaced = at_usual_speed(_small_scene(), chain)
    assert found is chain and not replaced.any()
    with pytest.raises(AssertionError, match="sought again"):
        at_usual_speed(_small_scene(), _steps_of([1.0] * 9 + [0.0]))


def _judged(monkeypatch, tried: dict[int, tuple[float, float, float]], own: float = 0.6):
    """A chain of ten steps, the sixth of which stood, whose directions lead to the ``tried`` (x, y, score)."""
    chain = _steps_of([0.0 if k == 5 else 1.0 + 0.01 * (k % 3) for k in range(10)])
    chain.score[5] = own
    answers = torch.tensor([tried.get(k, (0.0, 0.0, own)) for k in range(DIRECTIONS)], dtype=torch.float64)
    turns = torch.eye(2, dtype=torch.float64).expand(DIRECTIONS, 2, 2)
    found = chain.kept(torch.full((DIRECTIONS,), 5))
    found = found._replace(target_from_source=RigidMotion(turns, answers[:, :2]), score=answers[:, 2])
    monkeypatch.setattr("train.usual_speed._in_all_directions", lambda *_: found)
    after, replaced = at_usual_speed(_small_scene(), chain)
    assert replaced.nonzero().flatten().tolist() in ([], [5])
    return after.target_from_source.translation[5].tolist()


def test_of_several_answers_the_one_most_like_the_others_is_taken(monkeypatch):
    assert _judged(monkeypatch, {3: (1.0, 0.0, 0.3)}) == [1.0, 0.0]
    assert _judged(monkeypatch, {3: (1.0, 0.0, 0.3), 7: (1.03, 0.0, 0.31)}) == [1.0, 0.0], "the usual length"
    assert _judged(monkeypatch, {3: (1.0, 0.0, 0.3), 7: (-1.0, 0.0, 0.4)}) == [1.0, 0.0], "not back"
    assert _judged(monkeypatch, {3: (1.0, 0.0, 0.3), 7: (0.0, 1.0, 0.6)}) == [0.0, 1.0], "round a corner, if it fits"


def test_nothing_is_replaced_by_what_fits_badly_or_is_unlike_too(monkeypatch):
    assert _judged(monkeypatch, {3: (1.0, 0.0, 0.24)}) == [0.0, 0.0], "half of the others' score is 0.25"
    assert _judged(monkeypatch, {3: (1.0, 0.0, 0.12)}, own=0.2) == [1.0, 0.0], "or half of its own"
    assert _judged(monkeypatch, {3: (0.9, 0.0, 0.5)}) == [0.0, 0.0]
    assert _judged(monkeypatch, {3: (1.0, 0.0, 0.5)}, own=0.95) == [0.0, 0.0], "one view"


def test_pairs_of_the_window_across_a_replaced_step_are_registered_with_a_finite_reach(monkeypatch):
    known, asked = true_edges(small_world()), {}

    def registered(scene, pairs, start, kind, progress, *, far):
        asked.update({pair: far for pair in zip(*(side.tolist() for side in pairs), strict=True)})
        return known.kept(torch.zeros(len(pairs[0]), dtype=torch.long))

    monkeypatch.setattr(edges_file, "register_pairs", registered)
    scene = _small_scene()
    replaced = torch.arange(7) == 3  # the step from scan 3 to scan 4
    pairs = [(0, 2), (1, 3), (2, 4), (3, 5), (4, 6), (1, 4)]
    found = edges_file._registered(scene, pairs, true_poses(small_world()), replaced, silent)
    assert len(found.target) == len(pairs)
    assert asked == {(0, 2): True, (1, 3): True, (2, 4): False, (3, 5): False, (4, 6): True, (1, 4): False}


def test_the_first_step_is_held_against_the_second(monkeypatch):
    scans = small_world()
    steps = torch.tensor([[0.0, 0], [1, 0], [1, 0], [1, 0], [1, 0], [1, 0], [-1, 0]]).double()
    edges = true_edges(scans)
    chain = edges.kept(edges.source == edges.target + 1)
    motion = RigidMotion(chain.target_from_source.rotation, steps)
    chain = chain._replace(target_from_source=motion, score=torch.full((len(steps),), 0.8).double())

    def every_way(scene, edges, length, progress):
        angles = torch.arange(module.DIRECTIONS).double() * (2 * np.pi / module.DIRECTIONS)
        ways = length * torch.stack((angles.cos(), angles.sin()), -1)
        tried = edges.kept(torch.zeros(module.DIRECTIONS, dtype=torch.int64))
        return tried._replace(target_from_source=RigidMotion(tried.target_from_source.rotation, ways))

    monkeypatch.setattr(module, "_in_all_directions", every_way)
    found, replaced = module.at_usual_speed(build_scene(scans, prepare(scans, 180)), chain)
    assert replaced.tolist() == [True] + [False] * 6
    torch.testing.assert_close(found.target_from_source.translation[0], torch.tensor([1.0, 0.0]).double())
