"""The map pictures, read back pixel by pixel where the answer is known."""

import numpy as np
import pytest
from map_problems import room_result
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from train.drawing import INK, TIME_COLOURS, UNSEEN
from train.occupancy_grid import OccupancyGrid, occupancy_grid
from train.pictures import floor_plan, network_field, top_and_side_view


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    monkeypatch.setattr("train.drawing.DPI", 60)


def colours(figure: Figure, axes: Axes, places: np.ndarray) -> np.ndarray:
    """The drawn colours ``(n, 3)`` at places ``(n, 2)`` in the axes' coordinates."""
    figure.canvas.draw()
    image = np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255
    column, row = axes.transData.transform(places).T.astype(int)
    return image[len(image) - 1 - row, column]


def brightness(figure: Figure, axes: Axes, places: np.ndarray) -> np.ndarray:
    return colours(figure, axes, places).mean(axis=1)


@pytest.fixture
def room():
    result = room_result(error=0.0)
    return result, occupancy_grid(result.scans.points, result.world_from_scan)


def test_floor_plan_has_dark_walls_white_free_space_and_grey_beyond(room, monkeypatch):
    monkeypatch.setattr("train.drawing.DPI", 150)
    result, grid = room
    figure = floor_plan(result.world_points(), result.positions, grid, "m")
    axes = figure.axes[0]
    inside = np.random.default_rng(0).uniform(-1.8, -0.3, (200, 2))
    assert np.quantile(brightness(figure, axes, inside), 0.05) > 0.96
    assert np.median(brightness(figure, axes, result.world_points())) < 0.6
    beyond = np.stack((np.linspace(-1.9, 0.5, 50), np.full(50, 2.07)), axis=1)
    np.testing.assert_allclose(colours(figure, axes, beyond), np.tile(to_rgb(UNSEEN), (50, 1)), atol=0.02)


def test_floor_plan_colours_the_path_by_time(room):
    result, grid = room
    figure = floor_plan(result.world_points(), result.positions, grid, "m")
    middles = (result.positions[1:] + result.positions[:-1]) / 2
    expected = TIME_COLOURS(np.linspace(0, 1, 5))[1:, :3]
    np.testing.assert_allclose(colours(figure, figure.axes[0], middles), expected, atol=0.1)


def test_axes_are_equal_and_name_the_unit(room):
    result, grid = room
    for figure in (
        floor_plan(result.world_points(), result.positions, grid, "px"),
        network_field(lambda places: np.zeros(len(places)), result.positions, grid, "px"),
    ):
        axes = figure.axes[0]
        assert axes.get_aspect() == 1 and axes.get_xlabel() == "x (px)" and axes.get_ylabel() == "y (px)"
        assert "0.5 px" in {text.get_text() for text in axes.texts}


def test_the_scale_bar_is_as_long_as_it_says(room):
    result, grid = room
    axes = floor_plan(result.world_points(), result.positions, grid, "m").axes[0]
    (bar,) = (patch for patch in axes.patches if patch.get_facecolor()[:3] == to_rgb(INK))
    assert f"{bar.get_width():g} m" == axes.texts[0].get_text()


def test_3d_views_colour_by_height_and_share_their_scale():
    result = room_result(3, k=6, error=0.0)
    figure = top_and_side_view(result.world_points(), result.positions, "m")
    above, side = figure.axes[:2]
    assert above.get_aspect() == side.get_aspect() == 1
    assert (above.get_ylabel(), side.get_ylabel()) == ("y (m)", "z (m)")
    figure.canvas.draw()
    metres = [np.diff(axes.transData.transform([[0, 0], [1, 0]])[:, 0])[0] for axes in (above, side)]
    assert metres[0] == pytest.approx(metres[1], rel=0.01)
    heights = side.images[0].get_array()
    filled = heights.compressed() if np.ma.isMaskedArray(heights) else heights[np.isfinite(heights)]
    assert set(np.round(np.unique(filled), 6)) <= {0.0, 0.05, 1.0}


def test_from_above_the_highest_point_covers_those_below():
    axis = np.linspace(0, 1, 60)
    floor = np.insert(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2), 2, 0.0, axis=1)
    points = np.concatenate((floor + [0, 0, 2], floor))
    figure = top_and_side_view(points, np.array([[0.2, 0.2, 0.1], [0.8, 0.8, 0.1]]), "m")
    shown = np.ma.compressed(np.ma.masked_invalid(figure.axes[0].images[0].get_array()))
    assert len(shown) == len(floor) and set(shown) == {2.0}


@pytest.mark.parametrize("d", [2, 3])
def test_the_network_is_asked_where_it_is_drawn_and_veiled_where_no_ray_has_been(d):
    seen = np.zeros((40, 40), dtype=np.int32)
    seen[:20] = 1
    asked = []

    def right_half(places: np.ndarray) -> np.ndarray:
        asked.append(places)
        return (places[:, 0] > 0).astype(float)

    grid = OccupancyGrid(np.zeros_like(seen), seen, (-2.0, -2.0), 0.1)
    figure = network_field(right_half, np.array([[-0.5, -0.5, 0.3], [0.5, -0.5, 0.5]])[:, :d], grid, "m")
    assert asked[0].shape[1] == d and np.all(asked[0][:, 2:] == 0.4)
    places = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0]])
    left, right, unseen = brightness(figure, figure.axes[0], places)
    assert left > 0.95 and right < 0.05 and 0.7 < unseen < 0.9
