"""The bench of the mapper's rivals: its own point-to-line ICP, what the chains share, and the table."""

import numpy as np
import pytest

from benchmarks.map_rivals import gicp, kiss, multiway, point_to_line
from benchmarks.map_rivals.chain import (
    APART,
    GRAPH,
    GRAPH_YAW,
    PLAIN,
    YAW,
    Overlap,
    along,
    chained,
    from_turned_starts,
    in_own_unit,
    loop_pairs,
    reach,
    turned,
    window_pairs,
)
from benchmarks.map_rivals.floor_plans import FLOOR_PLANS
from benchmarks.map_rivals.table import (
    ERROR,
    OURS,
    SECONDS,
    best,
    lacking,
    marked,
    own_figures,
    parsed,
    standing,
    table_of,
)
from benchmarks.mapping_rivals import document
from train.evaluate import evaluate_trajectory
from train.poses import embed_poses
from train.scans import ScanSet, silent

TABLE = """Words.

| sequence | scans | ATE | points | unit | CPU seconds | |
|---|---|---|---|---|---|---|
| tum, stride 1 | 5 | 0.00139 | 0.00356 | m | 3 | met |
| dragon scans | 15 | 0.00105 | 0.00079 | m | 23 | **1.13 x** |
"""


def planar(degrees: float, x: float, y: float) -> np.ndarray:
    motion = turned(np.deg2rad(degrees), 3)
    motion[:2, 2] = x, y
    return motion


def room(samples: int = 60) -> np.ndarray:
    """Points on the walls of a room with a niche, about its middle, about one unit from it."""
    corners = np.array([(-1, -0.7), (1, -0.7), (1, 0.2), (0.5, 0.2), (0.5, 0.8), (-1, 0.8), (-1, -0.7)])
    share = (np.arange(samples) / samples)[:, None]
    walls = [a + share * (b - a) for a, b in zip(corners[:-1], corners[1:], strict=True)]
    return np.concatenate(walls)


def seen(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    d = points.shape[1]
    return (points - pose[:d, d]) @ pose[:d, :d]


def walk(dimension: int) -> ScanSet:
    """Four scans of the room with truth, in space with floor and walls of some height."""
    points = room()
    if dimension == 3:
        wall = np.concatenate([np.column_stack((points, np.full(len(points), z))) for z in np.linspace(-0.4, 0.6, 15)])
        ground = np.stack(np.meshgrid(np.linspace(-0.9, 0.4, 40), np.linspace(-0.6, 0.7, 40), [-0.4]), -1)
        points = np.concatenate((wall, ground.reshape(-1, 3)))
    poses = np.stack([planar(3 * i, 0.04 * i, 0.02 * i) for i in range(4)])
    truth = embed_poses(poses) if dimension == 3 else poses
    scans = [5.0 * seen(points, pose) for pose in truth]
    return ScanSet(scans, list("abcd"), np.arange(4.0), truth=in_own_unit(truth, 5.0))


def error(poses: np.ndarray, scans: ScanSet) -> float:
    return evaluate_trajectory(embed_poses(poses), embed_poses(scans.truth))["ape_rmse"]


@pytest.mark.parametrize("strangers", [0, 60])
def test_point_to_line_finds_a_known_motion(strangers):
    truth, points = planar(12.0, 0.15, -0.1), room()
    source = np.concatenate((seen(points[::2], truth), np.random.default_rng(0).uniform(-1, 1, (strangers, 2))))
    found, information = point_to_line.point_to_line(
        point_to_line.lines(points), point_to_line.lines(source), np.eye(3), 0.4
    )
    np.testing.assert_allclose(found, truth, atol=1e-6 if strangers == 0 else 5e-3)
    assert np.linalg.eigvalsh(information)[0] > 0.01


def test_a_single_wall_leaves_its_own_direction_unknown():
    wall = point_to_line.lines(np.column_stack((np.linspace(-1, 1, 50), np.zeros(50))))
    _, information = point_to_line.point_to_line(wall, wall, np.eye(3), 0.4)
    np.testing.assert_allclose(information[1], 0.0, atol=1e-12)


def test_point_to_line_maps_a_short_walk():
    scans = walk(2)
    found = dict(point_to_line.solved(scans, (0.4, False), silent))
    assert set(found) == {PLAIN, GRAPH, YAW, GRAPH_YAW}
    assert all(error(poses, scans) < 1e-4 for poses in found.values())


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("kind", ["GICP", "PLANE_ICP"])
def test_small_gicp_maps_a_short_walk(kind, dimension):
    scans = walk(dimension)
    for poses in dict(gicp.solved(scans, kind, gicp.Setting(0.02, (0.5, 0.1), True), silent)).values():
        assert error(poses, scans) < 0.05


@pytest.mark.parametrize("dimension", [2, 3])
def test_kiss_icp_maps_a_short_walk(dimension):
    pytest.importorskip("kiss_icp", reason="KISS-ICP comes with the extra peers")
    scans = walk(dimension)
    assert error(dict(kiss.solved(scans, 0.1, silent))[PLAIN], scans) < 0.2


@pytest.mark.filterwarnings("ignore")
def test_open3d_multiway_maps_a_short_walk():
    pytest.importorskip("open3d", reason="Open3D comes with the extra peers", exc_type=ImportError)
    scans = walk(3)
    for poses in dict(multiway.solved(scans, multiway.Setting(0.05, (0.5,)), silent)).values():
        assert error(poses, scans) < 0.05


class Stuck:
    """Answers its start; the two scans overlap turned by 90 degrees alone."""

    def __init__(self) -> None:
        points = np.column_stack((np.linspace(1, 2, 30), np.linspace(0, 0.3, 30)))
        self.points = [points, points, seen(points, turned(np.pi / 2, 3))]
        self.tolerance = 0.01

    def register(self, target, source, start):
        return start


def test_a_poor_pair_is_sought_from_turned_starts_and_a_good_one_left_alone():
    rival = Stuck()
    motions = chained(rival, 3, False, silent)
    found = from_turned_starts(rival, motions, silent)
    np.testing.assert_array_equal(found[0], np.eye(3))
    np.testing.assert_allclose(found[1], turned(np.pi / 2, 3), atol=1e-12)
    assert Overlap(rival.points, rival.tolerance)(1, 2, found[1]) == 1.0


def test_a_chain_begins_at_the_last_motion_when_it_is_to_follow():
    rival = Stuck()
    rival.register = lambda target, source, start: start @ planar(0.0, 1.0, 0.0)
    np.testing.assert_allclose(chained(rival, 3, True, silent)[:, 0, 2], [1.0, 2.0])
    np.testing.assert_allclose(chained(rival, 3, False, silent)[:, 0, 2], [1.0, 1.0])


def test_chained_poses_begin_at_the_origin_and_take_the_scans_unit():
    poses = in_own_unit(along(np.stack([planar(90.0, 1.0, 0.0)] * 2)), 3.0)
    np.testing.assert_allclose(poses[:, :2, 2], [[0, 0], [3, 0], [3, 3]], atol=1e-12)


def test_window_and_loop_pairs_are_near_and_not_neighbours():
    assert window_pairs(4) == [(0, 2), (1, 3), (0, 3)]
    there_and_back = np.stack([planar(0.0, min(i, 12 - i), 0.0) for i in range(13)])
    assert loop_pairs(there_and_back) == [(0, 12), (1, 11)]
    assert 11 - 1 >= APART


def test_the_reach_grows_with_the_scans():
    scans = walk(2)
    doubled = ScanSet([2 * x for x in scans.points], scans.names, scans.timestamps)
    assert reach(doubled) == pytest.approx(2 * reach(scans))


def test_a_planar_scan_becomes_a_wall():
    wall = gicp.walled(room(), 0.1)
    assert wall.shape == (gicp.ROWS * len(room()), 3)
    assert wall[:, 2].mean() == pytest.approx(0.0, abs=1e-12)


def test_our_own_figures_are_read_from_the_table_of_maps(tmp_path):
    path = tmp_path / "table.md"
    path.write_text(TABLE)
    assert parsed(TABLE)["dragon scans"]["points"] == "0.00079"
    own = own_figures(path)
    assert own["tum, stride 1"][OURS]["default"][PLAIN] == {ERROR: 0.00139, SECONDS: 3.0}
    assert own["dragon scans"][OURS]["default"][PLAIN][ERROR] == 0.00079


def numbers(value: float) -> dict[str, float]:
    return {ERROR: value, SECONDS: 1.0}


def test_each_rival_gets_its_better_setting_and_the_best_is_bold():
    results = {
        "a": {OURS: {"default": {PLAIN: numbers(0.2)}}, "x": {"s": {PLAIN: numbers(0.3)}, "t": {PLAIN: numbers(0.1)}}},
        "b": {OURS: {"default": {PLAIN: numbers(0.2)}}, "x": {"s": {PLAIN: numbers(np.inf)}}},
    }
    assert best(results["a"]["x"], PLAIN) == ("t", numbers(0.1))
    assert best(results["a"]["x"], YAW) is None
    lines = table_of(results, ["a", "b"], {"a": "m", "b": "m"})
    assert lines[2:] == ["| a | m | 0.2 | **0.1** |", "| b | m | **0.2** | inf |"]
    assert standing(results, ["a", "b"]) == "Ours is best, alone or level, in 1 of 2 rows.\n- a: x"


def test_settings_that_were_not_run_are_named():
    results = {"a": {"x": {"s": {PLAIN: numbers(0.3)}}}, "b": {}}
    assert lacking(results, {"a": {"x": ["s", "t"]}, "b": {"x": ["s"]}}) == [
        "- x, 0 of 1 settings: b",
        "- x, 1 of 2 settings: a",
    ]


def test_figures_that_print_alike_are_level():
    assert marked([0.1231, 0.1234, None, 0.2]) == ["**0.123**", "**0.123**", "", "0.2"]


def test_the_table_can_be_written_of_a_few_results():
    plan = next(iter(FLOOR_PLANS))
    text = document({plan: {OURS: {"default": {PLAIN: numbers(0.2)}}, "KISS-ICP": {"s": {PLAIN: numbers(0.3)}}}})
    assert f"| {plan} | m | **0.2** | 0.3 |" in text
