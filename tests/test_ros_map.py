"""The occupancy picture, read by the rules of ROS's map_server."""

import numpy as np
import pytest
import yaml
from map_problems import room_result
from PIL import Image

from train.occupancy_grid import OccupancyGrid, occupancy_grid
from train.ros_map import map_image, write_ros_map


def test_map_server_sees_walls_free_space_and_the_unknown(tmp_path):
    result = room_result(error=0.0)
    write_ros_map(tmp_path / "occupancy.png", occupancy_grid(result.scans.points, result.world_from_scan))
    description = yaml.safe_load((tmp_path / "occupancy.yaml").read_text())
    with Image.open(tmp_path / description["image"]) as image:
        assert image.mode == "L"
        grey = np.asarray(image, dtype=float)
    assert description["negate"] == 0 and description["origin"][2] == 0
    left, bottom, _ = description["origin"]

    def probability(x: float, y: float) -> float:
        row, column = int((y - bottom) / description["resolution"]), int((x - left) / description["resolution"])
        return (255 - grey[len(grey) - 1 - row, column]) / 255

    wall = [probability(*point) > description["occupied_thresh"] for point in result.world_points()]
    assert np.mean(wall) > 0.8
    assert probability(0.3, 0.1) < description["free_thresh"]
    assert description["free_thresh"] < probability(-2.07, 2.07) < description["occupied_thresh"]


def test_the_first_row_of_the_picture_is_the_top_of_the_map():
    hits, misses = np.zeros((3, 2), dtype=np.int32), np.zeros((3, 2), dtype=np.int32)
    hits[2, 0], misses[0, 1] = 1, 1
    np.testing.assert_array_equal(
        map_image(OccupancyGrid(hits, misses, (0.0, 0.0), 1.0)), [[0, 205], [205] * 2, [205, 254]]
    )


@pytest.mark.parametrize(("hits", "misses", "grey"), [(1, 0, 0), (0, 1, 254), (0, 0, 205), (1, 1, 205), (1, 3, 254)])
def test_weak_evidence_stays_unknown(hits, misses, grey):
    grid = OccupancyGrid(np.full((1, 1), hits), np.full((1, 1), misses), (0.0, 0.0), 1.0)
    assert map_image(grid)[0, 0] == grey
