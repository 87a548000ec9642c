"""Places seen again without poses: correlated pictures against literal sums, and loops believed by their witnesses."""

import functools

import numpy as np
import pytest
import torch
from small_worlds import true_edges, true_poses, world_of

from bbr_layer import RigidMotion
from train import edges as edges_file
from train import places
from train.config import EdgeConfig
from train.edges import register_edges
from train.places import alike, draw
from train.prepared import prepare
from train.recognition import SAME, recognised, witnesses
from train.scans import ScanSet, silent
from train.scene import Scene, build_scene
from train.simulate import WorldSettings

# Scans of a building that is once gone around, the last ones where the first were made.
SCANS, APART = 48, 9


@functools.cache
def _round_tour() -> tuple[ScanSet, Scene]:
    scans = world_of(WorldSettings(scans=SCANS, beams=180, seed=1))
    return scans, build_scene(scans, prepare(scans, 1000))


def _errors(target: torch.Tensor, source: torch.Tensor, motion: RigidMotion) -> torch.Tensor:
    truth = true_poses(_round_tour()[0])
    relative = truth.item(target).inverse() @ truth.item(source)
    return torch.linalg.vector_norm(relative.translation - motion.translation, dim=-1)


def _broken(poses: RigidMotion) -> RigidMotion:
    """The poses, from the middle on somewhere else."""
    jump = RigidMotion.from_rotvec(torch.tensor([0.6]).double(), torch.tensor([5.0, 2.0]).double())
    matrix = poses.matrix.clone()
    matrix[SCANS // 2 :] = jump.matrix @ matrix[SCANS // 2 :]
    return RigidMotion.from_matrix(matrix)


def test_the_likest_pairs_are_true_to_a_cell():
    _, scene = _round_tour()
    keys = list(range(0, SCANS, 2))
    likeness = alike(scene, keys, APART)
    assert len(likeness.score) == sum(b - a >= APART for a in keys for b in keys)
    assert (likeness.source - likeness.target >= APART).all()
    assert (likeness.score.diff() <= 0).all()
    first = slice(10)
    off = _errors(likeness.target[first], likeness.source[first], likeness.target_from_source.item(first))
    assert off.max() < 1.5 * draw(scene, keys).cell


def test_a_correlation_is_the_sum_over_cells():
    """At the best turn and shift, and less beside it: hits of each scan on what the other expects."""
    _, scene = _round_tour()
    pictures = draw(scene, [3, 40])
    best = alike(scene, [3, 40], APART)
    turn = round(best.target_from_source.rotvec.item() * places.TURNS / (2 * np.pi)) % places.TURNS
    shift = (best.target_from_source.translation[0] / pictures.cell).round().int().tolist()
    turned = [places._turned(picture[1])[turn] for picture in pictures[:2]]

    def shifted(picture: torch.Tensor, by: list[int]) -> torch.Tensor:
        return picture.roll(by, (0, 1))

    wanted = (shifted(turned[0], shift) * pictures.likely[0] + shifted(turned[1], shift) * pictures.hits[0]).sum()
    assert best.score.item() == pytest.approx(wanted.item(), rel=1e-4)
    for other in ([shift[0] + 1, shift[1]], [shift[0], shift[1] - 1]):
        less = (shifted(turned[0], other) * pictures.likely[0] + shifted(turned[1], other) * pictures.hits[0]).sum()
        assert less < wanted


def test_a_quarter_turn_of_a_picture_is_exact():
    picture = torch.rand(places.SIDE, places.SIDE)
    quarter = places._turned(picture)[places.TURNS // 4]
    torch.testing.assert_close(quarter, picture.rot90(1, (0, 1)), atol=1e-4, rtol=0)
    # the first axis turns towards the second: what lay along x lies along y
    point = torch.zeros(places.SIDE, places.SIDE)
    point[50, 32] = point[50, 31] = 1
    assert places._turned(point)[places.TURNS // 4][31:33, 50].sum() == pytest.approx(2, abs=1e-3)


def test_no_key_scans_far_enough_apart_are_no_loops():
    scans, scene = _round_tour()
    assert len(alike(scene, [0, 2, 4], APART).score) == 0
    assert len(recognised(scene, true_edges(scans), true_poses(scans), SCANS, silent).score) == 0


def test_loops_are_found_whatever_a_broken_chain_says():
    scans, scene = _round_tour()
    chain = true_edges(scans)
    chain = chain._replace(score=torch.full_like(chain.score, 0.4))
    found = recognised(scene, chain, _broken(true_poses(scans)), APART, silent)
    off = _errors(found.target, found.source, found.target_from_source)
    across = (found.target < SCANS // 2) & (found.source >= SCANS // 2)
    assert (across & (off < scene.spacing)).sum() > 20
    assert (off < scene.spacing).double().mean() > 0.95, "rooms that look alike have fewer witnesses"
    assert (found.kind == 2).all()
    assert found.score.min() >= 0.2, "half of the chain's median"


def test_a_loop_is_believed_by_its_witnesses():
    scans, scene = _round_tour()
    poses = true_poses(scans)
    chain = true_edges(scans)
    pairs = [(0, 40), (1, 41), (2, 42), (0, 42), (20, 30)]
    target, source = torch.tensor(pairs).unbind(1)
    motion = poses.item(target).inverse() @ poses.item(source)
    loops = chain.kept(torch.zeros(len(pairs), dtype=torch.int64))._replace(
        target=target, source=source, target_from_source=motion
    )
    assert witnesses(scene, loops, poses, 3).tolist() == [3, 3, 3, 3, 0]
    assert witnesses(scene, loops, poses, 1).tolist() == [1, 3, 1, 1, 0]
    off = torch.zeros(len(pairs), 2, dtype=torch.float64)
    off[1, 0] = 2 * SAME * scene.spacing
    wrong = loops._replace(target_from_source=RigidMotion(motion.rotation, motion.translation + off))
    assert witnesses(scene, wrong, poses, 3).tolist() == [2, 0, 2, 2, 0]


def test_a_chain_broken_in_the_middle_is_mended_by_places(monkeypatch):
    """A wrong neighbour, its window's edges and every later pose: without loops from no poses nothing mends them."""
    scans, _ = _round_tour()
    honest = edges_file.consecutive

    def broken_chain(*arguments: object) -> object:
        edges = honest(*arguments)
        translation, score = edges.target_from_source.translation.clone(), edges.score.clone()
        translation[SCANS // 2] += torch.tensor([6.0, 3.0])
        score[SCANS // 2] = 0.0
        return edges._replace(
            target_from_source=RigidMotion(edges.target_from_source.rotation, translation), score=score
        )

    monkeypatch.setattr(edges_file, "consecutive", broken_chain)
    # so long a step is sought again at the usual speed too, which is not what is shown here
    monkeypatch.setattr(
        edges_file, "at_usual_speed", lambda scene, chain, _: (chain, torch.zeros_like(chain.score) > 0)
    )
    _, poses = register_edges(scans, EdgeConfig())
    assert (poses.translation - true_poses(scans).translation).norm(dim=-1).max() < 0.05
    monkeypatch.setattr(edges_file, "recognised", lambda scene, edges, *_: edges.kept(edges.kind < 0))
    _, lost = register_edges(scans, EdgeConfig())
    assert (lost.translation - true_poses(scans).translation).norm(dim=-1).max() > 1.0
