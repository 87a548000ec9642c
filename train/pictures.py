"""The pictures of a map: floor plan (2D), top and side view (3D), and what the occupancy network believes."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from train.drawing import (
    ACCENT,
    HEIGHT_COLOURS,
    HEIGHT_QUANTILES,
    INK,
    LONG_SIDE,
    TIME_COLOURS,
    UNSEEN,
    colour_bar,
    coloured_path,
    legend,
    mark_ends,
    new_figure,
    plan_axes,
    scale_bar,
)
from train.occupancy_grid import OccupancyGrid

# Blur of the free space, in grid cells: closes the gaps between single rays without reaching through walls.
FREE_BLUR = 0.7
# Scans that saw a cell free until it is drawn 63 % white.
CLEARLY_FREE = 1.5
# Most points drawn as dots; beyond it they overlap everywhere.
DOTS = 400_000
# Area of a dot in square points of type, where there are at least so many; sparser maps get dots up to thrice as large.
DOT_SIZE, DENSE, LARGEST_DOT = 0.6, 60_000, 3.0
# Pixels across the 3D views; fewer than the picture has, so that single points stay visible.
VIEW_PIXELS = 1100
# The 3D views show what lies between these quantiles along x and y, and the path, with a margin as a share.
VIEW_QUANTILES = (0.01, 0.99)
VIEW_MARGIN = 0.05
# Cells along the longer side at which the occupancy network is asked.
FIELD_CELLS = 400
# Opacity of the veil over what no ray has reached, and how far, in grid cells, it draws back from single rays.
VEIL, VEIL_BLUR = 0.93, 2.0


def floor_plan(
    points: Float[np.ndarray, "n 2"], positions: Float[np.ndarray, "k 2"], grid: OccupancyGrid, unit: str
) -> Figure:
    """A 2D map: dark points, free space white, the unseen grey, the path coloured by time.

    Parameters
    ----------
    points: the merged map ``(n, 2)`` in the world frame.
    positions: where the sensor was ``(k, 2)``, in time order.
    grid: what the rays saw.
    unit: name of the data's unit, for the labels.
    """
    figure, axes = _plan(grid.extent, unit)
    axes.set_facecolor(UNSEEN)
    free = gaussian_filter(np.where(grid.probability < 0.5, grid.misses, 0).astype(np.float32), FREE_BLUR)
    white = np.ones((*free.shape, 4), dtype=np.float32)
    white[..., 3] = 1 - np.exp(-free / CLEARLY_FREE)
    axes.imshow(white, origin="lower", extent=grid.extent, interpolation="bilinear", zorder=1)
    dots = points[:: -(-len(points) // DOTS)]
    size = DOT_SIZE * np.clip(np.sqrt(DENSE / len(dots)), 1, LARGEST_DOT)
    axes.scatter(dots[:, 0], dots[:, 1], s=size, c=INK, linewidths=0, zorder=2)
    path = coloured_path(axes, positions, np.arange(len(positions), dtype=float), TIME_COLOURS)
    mark_ends(axes, positions)
    colour_bar(figure, axes, path, "scan")
    _finish(axes, grid.extent, unit)
    return figure


def top_and_side_view(points: Float[np.ndarray, "n 3"], positions: Float[np.ndarray, "k 3"], unit: str) -> Figure:
    """A 3D map (z up) coloured by height: from above, the highest point on top, and below it from the side.

    The side view shares the x axis and looks along y; both have equal axes. Parameters as for ``floor_plan``.
    """
    low, high = np.quantile(points[:, 2], HEIGHT_QUANTILES)
    (left, bottom, floor), (right, top, ceiling) = _viewed_box(points, positions)
    heights = (top - bottom, ceiling - floor)
    scale = LONG_SIDE / max(right - left, sum(heights))
    figure = new_figure((right - left) * scale + 1.5, sum(heights) * scale + 1.0)
    above, side = figure.subplots(2, 1, sharex=True, height_ratios=heights)
    shown = points[(points[:, 2] >= floor) & (points[:, 2] <= ceiling)]
    for axes, across, limits in ((above, 1, (bottom, top)), (side, 2, (floor, ceiling))):
        extent = (left, right, *limits)
        order = np.argsort(shown[:, 2] if across == 1 else -shown[:, 1])  # what is nearer to the eye comes last
        image = axes.imshow(
            _raster(shown[order][:, [0, across]], shown[order, 2], extent),
            origin="lower",
            extent=extent,
            cmap=HEIGHT_COLOURS,
            vmin=low,
            vmax=high,
            zorder=1,
            interpolation="nearest",
        )
        path = positions[:, [0, across]]
        axes.plot(*path.T, color=ACCENT, lw=1.6, zorder=4)
        mark_ends(axes, path)
        plan_axes(axes, unit, ("x", "yz"[across - 1]))
        axes.set_xlim(left, right)
        axes.set_ylim(*limits)
    above.set_xlabel("")
    scale_bar(above, unit)
    legend(above)
    colour_bar(figure, [above, side], image, f"height ({unit})")
    return figure


def network_field(
    occupancy: Callable[[np.ndarray], np.ndarray], positions: Float[np.ndarray, "k d"], grid: OccupancyGrid, unit: str
) -> Figure:
    """The occupancy network's probability over the area of the map; in 3D at the median height of the sensor.

    Where no ray has been, the network was never taught: that part is veiled.
    """
    left, right, bottom, top = grid.extent
    cell = max(right - left, top - bottom) / FIELD_CELLS
    x, y = _centres(left, right, cell), _centres(bottom, top, cell)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    if positions.shape[1] == 3:
        places = np.column_stack((places, np.full(len(places), np.median(positions[:, 2]))))
    probability = np.asarray(occupancy(places)).reshape(len(y), len(x))
    figure, axes = _plan(grid.extent, unit)
    image = axes.imshow(
        probability, origin="lower", extent=grid.extent, cmap="Greys", vmin=0, vmax=1, interpolation="nearest"
    )
    veil = np.tile(np.array(to_rgba(UNSEEN), dtype=np.float32), (*grid.observed.shape, 1))
    veil[..., 3] = VEIL * (1 - np.clip(4 * gaussian_filter(grid.observed.astype(np.float32), VEIL_BLUR), 0, 1))
    axes.imshow(veil, origin="lower", extent=grid.extent, interpolation="bilinear")
    axes.plot(*positions[:, :2].T, color=ACCENT, lw=1.0)
    mark_ends(axes, positions[:, :2])
    colour_bar(figure, axes, image, "probability of being occupied")
    _finish(axes, grid.extent, unit)
    return figure


def _centres(low: float, high: float, cell: float) -> np.ndarray:
    """Centres of equal cells, about ``cell`` wide, that fill the span."""
    edges = np.linspace(low, high, max(round((high - low) / cell), 1) + 1)
    return (edges[1:] + edges[:-1]) / 2


def _plan(extent: tuple[float, float, float, float], unit: str) -> tuple[Figure, Axes]:
    """A figure with one plan view that fills it."""
    left, right, bottom, top = extent
    scale = LONG_SIDE / max(right - left, top - bottom)
    figure = new_figure((right - left) * scale + 1.2, (top - bottom) * scale + 0.6)
    axes = figure.add_subplot()
    plan_axes(axes, unit)
    return figure, axes


def _finish(axes: Axes, extent: tuple[float, float, float, float], unit: str) -> None:
    axes.set_xlim(*extent[:2])
    axes.set_ylim(*extent[2:])
    scale_bar(axes, unit)
    legend(axes)


def _viewed_box(points: np.ndarray, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner ``(3,)`` of what the 3D views show: nearly all points, and the path."""
    quantiles = np.array([VIEW_QUANTILES, VIEW_QUANTILES, HEIGHT_QUANTILES])
    box = np.array([np.quantile(points[:, a], quantiles[a]) for a in range(3)])
    low, high = np.minimum(box[:, 0], positions.min(axis=0)), np.maximum(box[:, 1], positions.max(axis=0))
    margin = VIEW_MARGIN * np.max(high - low)
    return low - margin, high + margin


def _raster(
    places: np.ndarray, values: np.ndarray, extent: tuple[float, float, float, float]
) -> Float[np.ndarray, "rows columns"]:
    """The last value that falls into each pixel of the extent, NaN where none does."""
    left, right, bottom, top = extent
    pixel = (right - left) / VIEW_PIXELS
    rows, columns = max(int((top - bottom) / pixel), 1), VIEW_PIXELS
    image = np.full((rows, columns), np.nan)
    column = ((places[:, 0] - left) / (right - left) * columns).astype(int)
    row = ((places[:, 1] - bottom) / (top - bottom) * rows).astype(int)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    image[row[inside], column[inside]] = values[inside]
    return image
