"""What contradicts other scans is told from what stands still; and it leaves the map."""

import numpy as np
import torch
from small_worlds import true_edges

from bbr_layer import RigidMotion, read_cloud
from train.free_space_evidence import RangeView, range_views
from train.moving_points import MovingPoints
from train.outputs import MapResult, write_outputs
from train.prepared import prepare
from train.scans import ScanSet
from train.scene import build_scene, scores
from train.surfaces import surfaces

WALL, RAYS, SCANS = 2.0, 360, 6
ANGLES = np.linspace(0, 2 * np.pi, RAYS, endpoint=False) + 1e-3


def _hall(walks: bool) -> tuple[ScanSet, np.ndarray]:
    """A square hall from six places; a column of radius 0.2 stands in it or walks through it. Which points are its."""
    rays = np.stack((np.cos(ANGLES), np.sin(ANGLES)), axis=1)
    points, labels, poses = [], [], []
    for scan in range(SCANS):
        sensor = np.array([-1.0 + 0.1 * scan, -0.5])
        column = np.array([0.5, -0.8 + 0.5 * scan if walks else 0.4]) - sensor
        far = np.min((np.sign(rays) * WALL - sensor) / rays, axis=1)
        along = rays @ column
        room = along**2 - (column**2).sum() + 0.04
        met = np.where((room > 0) & (along > 0), along - np.sqrt(np.maximum(room, 0)), np.inf)
        points.append(rays * np.minimum(met, far)[:, None])
        labels.append(met < far)
        poses.append(np.array([[1, 0, sensor[0]], [0, 1, sensor[1]], [0, 0, 1.0]]))
    truth = np.linalg.inv(poses[0]) @ np.stack(poses)
    names = [str(number) for number in range(SCANS)]
    return ScanSet(points, names, np.arange(SCANS, dtype=float), truth=truth), np.concatenate(labels)


def test_a_walking_column_has_moved_and_the_walls_have_not():
    scans, column = _hall(walks=True)
    moving = MovingPoints(scans, true_edges(scans), scans.truth)
    assert moving.moved[column].mean() > 0.9
    assert moving.moved[~column].mean() < 0.02
    assert moving.share[column].mean() > 0.8 > 0.1 > moving.share[~column].mean()


def test_a_standing_column_has_not_moved():
    scans, column = _hall(walks=False)
    moving = MovingPoints(scans, true_edges(scans), scans.truth)
    assert column.sum() > 50 and moving.moved.mean() < 0.02


def test_a_ray_sees_through_what_stands_well_before_its_end():
    scans = _hall(walks=False)[0]
    points, view = scans.points[0], range_views(scans, surfaces(prepare(scans, RAYS)))[0]
    assert view is not None
    seen = [view.saw_through(share * points).mean() for share in (0.5, 0.97, 1.03, 1.5)]
    assert seen[0] > 0.9 and max(seen[1:]) == 0
    assert not view.saw_through(points * 0.5 + 1e3).any()  # where no ray went


def test_a_scan_looked_where_its_rays_ended_at_whatever_distance():
    scans = _hall(walks=False)[0]
    half = ScanSet([points[: RAYS // 2] for points in scans.points], scans.names, scans.timestamps)  # y above 0
    view = range_views(half, surfaces(prepare(half, RAYS)))[0]
    assert view is not None
    for share in (0.1, 1.0, 10.0):
        looked = view.looked_at(share * scans.points[0])
        assert looked[: RAYS // 2].all() and looked[RAYS // 2 :].sum() < 10


def test_a_witness_that_found_a_point_did_not_see_through_it(monkeypatch):
    scans, _ = _hall(walks=False)
    edges = true_edges(scans)
    monkeypatch.setattr(RangeView, "saw_through", lambda self, points: np.ones(len(points), dtype=bool))
    moving = MovingPoints(scans, edges, scans.truth)
    partners = np.bincount(torch.cat((edges.target, edges.source)).numpy(), minlength=SCANS)
    assert (moving.found + moving.seen_through == np.repeat(partners, RAYS)).all()
    assert moving.found.sum() > 0 < moving.seen_through.sum()


def test_contradictions_weigh_against_a_motion(monkeypatch):
    scans, _ = _hall(walks=False)
    scene = build_scene(scans, prepare(scans, RAYS))
    pairs = torch.tensor([0]), torch.tensor([3])
    truth = RigidMotion.from_matrix(torch.from_numpy(scans.truth[3:4]))
    wrong = RigidMotion(truth.rotation, truth.translation + torch.tensor([0.8, 0.0]))
    right, off = (scores(scene, pairs, motion) for motion in (truth, wrong))
    monkeypatch.setattr("train.scene.CONTRADICTION", 0.0)
    right_alone, off_alone = (scores(scene, pairs, motion) for motion in (truth, wrong))
    assert right > off
    assert off < 0.8 * off_alone and right > 0.9 * right_alone


def test_without_edges_nobody_bears_witness():
    scans, _ = _hall(walks=True)
    assert not MovingPoints(scans, None, scans.truth).moved.any()


def test_what_moved_leaves_the_map(tmp_path, monkeypatch):
    given = {}
    monkeypatch.setattr(
        "train.outputs._pictures", lambda result, points, grid: given.update(pictures=len(points)) or {}
    )
    monkeypatch.setattr(
        "train.outputs.write_browser_map", lambda path, points, *told, names: given.update(browser=len(points))
    )
    scans, column = _hall(walks=True)
    edges = true_edges(scans)
    metrics = write_outputs(tmp_path, MapResult(scans, scans.truth, edges))
    still, moved = read_cloud(tmp_path / "map.ply"), read_cloud(tmp_path / "movers.ply")
    assert len(still.points) + len(moved.points) == len(column)
    assert len(moved.points) == metrics["moving_points"] > 0.9 * column.sum()
    assert given["pictures"] == given["browser"] == len(still.points)
    write_outputs(
        tmp_path, MapResult(_hall(walks=False)[0], scans.truth, edges._replace(score=torch.zeros(len(edges.score))))
    )
    assert not (tmp_path / "movers.ply").exists()


def test_a_point_at_the_sensor_is_no_ray():
    scans = _hall(walks=False)[0]
    with_origin = ScanSet(
        [np.vstack((np.zeros((1, 2)), points)) for points in scans.points], scans.names, scans.timestamps
    )
    view = range_views(with_origin, surfaces(prepare(scans, RAYS)))[0]
    assert view is not None and len(view.ranges) == RAYS


def test_edges_that_nobody_believes_bear_no_witness():
    scans, _ = _hall(walks=True)
    edges = true_edges(scans)
    moving = MovingPoints(scans, edges._replace(score=torch.zeros_like(edges.score)), scans.truth)
    assert not moving.found.any() and not moving.seen_through.any()
