"""Registered edges and the pose graph: known motions found, wrong edges survived, the first pose kept."""

import numpy as np
import pytest
import torch
from small_worlds import small_world, true_edges, true_poses

from bbr_layer import RigidMotion, angular_error
from train import edges as edges_file
from train.chain import POOR, consecutive
from train.config import EdgeConfig
from train.edges import NEAR, register_edges
from train.given_motion import GIVEN
from train.loops import DOUBTED, again
from train.pose_graph import Edges, solve_pose_graph
from train.prepared import prepare
from train.scans import ScanSet, silent
from train.scene import build_scene
from train.spanning_tree import spanning_poses


def _circle(scans: int, d: int) -> RigidMotion:
    """Poses on a circle of radius 5, turning with it."""
    angles = torch.linspace(0, 2 * torch.pi * (1 - 1 / scans), scans, dtype=torch.float64)
    turn = angles[:, None] if d == 2 else angles[:, None] * torch.tensor([0.0, 0.1, 1.0], dtype=torch.float64)
    places = torch.stack((5 * torch.sin(angles), 5 - 5 * torch.cos(angles)), 1)
    places = places if d == 2 else torch.cat((places, 0.1 * angles[:, None]), 1)
    world = RigidMotion.from_rotvec(turn, places)
    return world.item(0).inverse() @ world


def _edges(world: RigidMotion, pairs: list[tuple[int, int]], noise: float = 0.0) -> Edges:
    target, source = torch.tensor(pairs).unbind(1)
    d = world.dimension
    k = d * (d + 1) // 2
    motion = world.item(target).inverse() @ world.item(source)
    shaken = RigidMotion.from_rotvec(
        noise * torch.randn(len(pairs), k - d, dtype=torch.float64), noise * torch.randn(len(pairs), d).double()
    )
    return Edges(
        target,
        source,
        shaken @ motion,
        torch.eye(k, dtype=torch.float64).expand(len(pairs), k, k),
        torch.zeros(len(pairs), d, dtype=torch.float64),
        torch.ones(len(pairs), dtype=torch.float64),
        torch.where(source - target == 1, 0, 2),
    )


@pytest.mark.parametrize("d", [2, 3])
def test_pose_graph_finds_the_poses_and_drops_wrong_loops(d):
    world = _circle(20, d)
    pairs = [(i, i + 1) for i in range(19)] + [(i, i + 2) for i in range(18)] + [(0, 19), (1, 18), (2, 17)]
    edges = _edges(world, pairs, noise=1e-3)
    wrong = _edges(world, [(3, 12), (5, 16)])
    wrong = wrong._replace(
        target_from_source=RigidMotion(wrong.target_from_source.rotation, wrong.target_from_source.translation + 2.0)
    )
    poses, weights = solve_pose_graph(edges.joined(wrong), spanning_poses(edges, 20))
    assert torch.equal(poses.translation[0], torch.zeros(d, dtype=torch.float64))
    assert (poses.translation - world.translation).norm(dim=-1).max() < 0.02
    assert angular_error(poses.rotation, world.rotation).max() < 0.01
    assert weights[-2:].max() < 0.01 < 0.3 < weights[:-2].median()


@pytest.mark.parametrize("d", [2, 3])
def test_exact_edges_are_met_exactly_from_a_poor_start(d):
    world = _circle(12, d)
    edges = _edges(world, [(i, j) for i in range(12) for j in (i + 1, i + 2, i + 5) if j < 12])
    start = _circle(12, d)
    start = RigidMotion(start.rotation, start.translation * 1.1)
    poses, _ = solve_pose_graph(edges, start)
    torch.testing.assert_close(poses.matrix, world.matrix, rtol=0, atol=1e-7)


def test_scans_that_no_edge_joins_are_refused():
    with pytest.raises(ValueError, match="3 edges join 4 scans to the first; there are 6"):
        spanning_poses(_edges(_circle(6, 2), [(0, 1), (1, 2), (2, 3)]), 6)


@pytest.mark.parametrize("d", [2, 3])
def test_the_first_poses_go_along_the_best_edges(d):
    world = _circle(6, d)
    edges = _edges(world, [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (1, 4), (0, 5)])
    wrong = edges.target_from_source.translation.clone()
    wrong[2] += 3.0
    score = torch.tensor([0.9, 0.8, 0.1, 0.7, 0.6, 0.5, 0.8], dtype=torch.float64)
    edges = edges._replace(target_from_source=RigidMotion(edges.target_from_source.rotation, wrong), score=score)
    torch.testing.assert_close(spanning_poses(edges, 6).matrix, world.matrix, rtol=0, atol=1e-12)


def test_of_two_edges_of_one_pair_the_better_one_counts():
    world = _circle(3, 2)
    edges = _edges(world, [(0, 1), (0, 1), (1, 2), (1, 2)])
    wrong = edges.target_from_source.translation.clone()
    wrong[[0, 3]] += 3.0
    score = torch.tensor([0.2, 0.9, 0.9, 0.2], dtype=torch.float64)
    edges = edges._replace(target_from_source=RigidMotion(edges.target_from_source.rotation, wrong), score=score)
    torch.testing.assert_close(spanning_poses(edges, 3).matrix, world.matrix, rtol=0, atol=1e-12)


def _room(scans: int, rays: int = 180) -> ScanSet:
    """Scans of an L-shaped room by a sensor that walks and turns, exact ranges."""
    corners = np.array([[0, 0], [8, 0], [8, 3], [5, 3], [5, 7], [0, 7]], dtype=float)
    walls = [(a, b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    poses, points = [], []
    for step in range(scans):
        place, heading = np.array([1.5 + 0.3 * step, 1.5]), 0.1 * step
        angles = heading + 0.003 + np.linspace(0, 2 * np.pi, rays, endpoint=False)
        rays_world = np.stack((np.cos(angles), np.sin(angles)), 1)
        ranges = np.full(rays, np.inf)
        for corner, along in walls:
            det = along[0] * rays_world[:, 1] - along[1] * rays_world[:, 0]
            gap = corner - place
            far = (along[0] * gap[1] - along[1] * gap[0]) / det
            share = (rays_world[:, 0] * gap[1] - rays_world[:, 1] * gap[0]) / det
            hit = (far > 0) & (share >= 0) & (share <= 1)
            ranges = np.where(hit & (far < ranges), far, ranges)
        c, s = np.cos(heading), np.sin(heading)
        poses.append(np.array([[c, -s, place[0]], [s, c, place[1]], [0, 0, 1]]))
        points.append((rays_world * ranges[:, None]) @ np.array([[c, -s], [s, c]]))
    truth = np.linalg.inv(poses[0]) @ np.stack(poses)
    return ScanSet(points, [str(i) for i in range(scans)], np.arange(scans, dtype=float), None, truth)


def test_scans_of_a_room_are_mapped_without_any_starting_pose():
    scans, reports = _room(8), []
    edges, poses = register_edges(scans, EdgeConfig(window=2, points=180), lambda *told: reports.append(told))
    truth = RigidMotion.from_matrix(torch.from_numpy(scans.truth))
    assert (poses.translation - truth.translation).norm(dim=-1).max() < 0.02
    assert {0, 1} <= set(edges.kind.tolist())
    assert reports[0][0] == "consecutive scans" and reports[-1][1] == reports[-1][2]


@pytest.mark.parametrize("count", [2, 3])
def test_a_few_scans_are_enough(count):
    scans = _room(count)
    edges, poses = register_edges(scans, EdgeConfig(points=180))
    assert len(edges.kind) == count * (count - 1) // 2
    assert np.abs(poses.matrix.numpy() - scans.truth).max() < 0.02


def test_scans_are_thinned_evenly_and_padded():
    scans = _room(3)
    shorter = ScanSet([scans.points[0][:40], *scans.points[1:]], scans.names, scans.timestamps)
    prepared = prepare(shorter, 100)
    assert prepared.points.shape[:2] == prepared.mask.shape
    assert prepared.mask.sum(1)[0] == 40 and 60 < prepared.mask.sum(1)[1] <= 100
    assert torch.equal(prepared.points[0, :40], torch.from_numpy(scans.points[0][:40]).float())
    torch.testing.assert_close(prepared.normals[prepared.mask].norm(dim=-1), torch.ones(int(prepared.mask.sum())))


def test_a_poor_neighbour_is_sought_again_from_turned_starts(monkeypatch):
    scans = _room(5)
    c, s = np.cos(np.deg2rad(75)), np.sin(np.deg2rad(75))
    start = scans.truth.copy()
    start[4, :2, :2] = start[4, :2, :2] @ np.array([[c, -s], [s, c]])
    given = ScanSet(scans.points, scans.names, scans.timestamps, start, scans.truth)
    scene, wanted = build_scene(scans, prepare(scans, 180)), np.linalg.inv(scans.truth[3]) @ scans.truth[4]
    monkeypatch.setattr("train.chain.UNLIKE", np.inf)  # or its neighbours' motion would save it
    for poor, saved in ((POOR, True), (-1.0, False)):
        monkeypatch.setattr("train.chain.POOR", poor)
        found = consecutive(scene, given, silent)
        last = found.kept(found.source == 4).target_from_source.matrix[0].numpy()
        assert (np.abs(last - wanted).max() < 0.02) == saved


def test_an_edge_that_the_graph_does_not_believe_is_registered_anew():
    scans = _room(4)
    scene, truth = build_scene(scans, prepare(scans, 180)), RigidMotion.from_matrix(torch.from_numpy(scans.truth))
    edges = _edges(truth, [(0, 1), (1, 2), (2, 3)])
    wrong = edges.target_from_source.translation.clone()
    wrong[1] += 0.5
    edges = edges._replace(target_from_source=RigidMotion(edges.target_from_source.rotation, wrong))
    edges = edges._replace(score=torch.tensor([0.9, 0.0, 0.9], dtype=torch.float64))
    found = again(scene, edges, torch.tensor([1.0, 0.0, 1.0]).double(), truth, None)
    wanted = truth.item(1).inverse() @ truth.item(2)
    assert (found.target_from_source.translation[1] - wanted.translation).norm() < 0.02
    assert found.source.tolist() == [1, 2, 3] and found.score[1] > 0.5


@pytest.mark.parametrize(("rounds", "moving", "asked"), [(2, 0, 2), (2, 3, 4), (1, 100, 4), (0, 100, 0)])
def test_loops_are_sought_on_while_scans_move_but_not_for_ever(monkeypatch, rounds, moving, asked):
    scans, calls = _room(4), []

    def none(scene, poses, edges, *rest, weights):
        calls.append(0)
        return edges.kept(edges.kind < 0)

    def moved(scene, edges, starts):
        poses, belief = solve_pose_graph(edges, starts[0])
        return RigidMotion(poses.rotation, poses.translation + 10.0 * (len(calls) <= moving)), belief

    monkeypatch.setattr("train.edges.loops", none)
    monkeypatch.setattr("train.edges.agreed_poses", moved)
    monkeypatch.setattr("train.edges.refined", lambda full, scene, graph, poses, progress: poses)
    register_edges(scans, EdgeConfig(window=2, points=180, rounds=rounds))
    assert len(calls) == asked


def test_normals_of_dense_scans_reach_over_more_neighbours(monkeypatch):
    asked = []
    monkeypatch.setattr("train.prepared.estimate_normals", lambda points, k: asked.append(k) or points)
    for d, count in ((2, 20_000), (3, 500), (3, 10_000), (3, 100_000)):
        prepare(ScanSet([np.random.default_rng(0).normal(size=(count, d))] * 2, ["a", "b"], np.arange(2.0)), 100)
    assert asked[::2] == [6, 13, 20, 30]


def test_a_loop_that_the_graph_does_not_believe_is_dropped(monkeypatch):
    scans, asked, doubted = _room(8), [], []

    def one_wrong_loop(scene, poses, edges, *rest, weights):
        asked.append(int((edges.kind == 2).sum()))
        loop = _edges(poses, [(0, 7)])
        away = RigidMotion(loop.target_from_source.rotation, loop.target_from_source.translation + 3.0)
        return loop._replace(target_from_source=away) if len(asked) == 1 else edges.kept(edges.kind < 0)

    def spied(scene, edges, belief, *rest):
        doubted.append(int((belief < DOUBTED).sum()))
        return again(scene, edges, belief, *rest)

    monkeypatch.setattr("train.edges.loops", one_wrong_loop)
    monkeypatch.setattr("train.edges.again", spied)
    edges, poses = register_edges(scans, EdgeConfig(window=2, points=180, rounds=2))
    assert asked == [0, 0] and not (edges.kind == 2).any()
    assert doubted == [0, 1]  # the loop, in the second round
    assert np.abs(poses.matrix.numpy() - scans.truth).max() < 0.02


@pytest.mark.parametrize("d", [2, 3])
def test_a_doubted_edge_that_the_poses_nearly_agree_with_counts_in_the_refinement(monkeypatch, d):
    asked = {}

    def refine(clouds, pairs, found, weights, progress):
        asked["trust"] = weights[0]
        return found

    monkeypatch.setattr(edges_file, "refine", refine)
    scans = small_world(d)
    edges, poses, full = true_edges(scans), true_poses(scans), prepare(scans, 200)
    scene = build_scene(scans, full)
    count, width = len(edges.target), NEAR * scene.spacing
    shift, turn = torch.zeros(count, d, dtype=torch.float64), torch.zeros(count, d * (d - 1) // 2, dtype=torch.float64)
    shift[1, 0], shift[2, 0], shift[4, 0] = width / 2, 4 * width, 1.0
    turn[3, -1] = 4 * width / full.points[int(edges.source[3])].square().sum(-1).mean().sqrt()
    turned = RigidMotion.from_rotvec(turn, shift).rotation @ edges.target_from_source.rotation
    centre = edges.target_from_source(edges.centre[:, None])[:, 0] + shift
    off = RigidMotion(turned, centre - (turned @ edges.centre[..., None])[..., 0])
    belief = torch.zeros(count, dtype=torch.float64)
    belief[4] = 0.7
    edges_file.refined(full, scene, (edges._replace(target_from_source=off), belief), poses, silent)
    np.testing.assert_allclose(asked["trust"], [1.0, 0.64, 0.0, 0.0, 0.7] + [1.0] * (count - 5), rtol=1e-6)


def test_a_given_motion_that_the_graph_does_not_believe_stays_as_it_was():
    scans = _room(3)
    scene, truth = build_scene(scans, prepare(scans, 180)), RigidMotion.from_matrix(torch.from_numpy(scans.truth))
    edges = _edges(truth, [(0, 1), (1, 2), (1, 2)])
    wrong = edges.target_from_source.translation.clone()
    wrong[2] += 0.5
    edges = edges._replace(
        target_from_source=RigidMotion(edges.target_from_source.rotation, wrong),
        score=torch.tensor([0.9, 0.9, 0.0]).double(),
        kind=torch.tensor([0, 0, GIVEN]),
    )
    found = again(scene, edges, torch.tensor([1.0, 1.0, 0.0]).double(), truth, None)
    assert torch.equal(found.target_from_source.matrix, edges.target_from_source.matrix)
