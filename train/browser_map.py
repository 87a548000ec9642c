"""The map to turn in a browser: one self-contained HTML page."""

from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Float

from bbr_layer import atomic_write
from train.drawing import ACCENT, HEIGHT_QUANTILES, INK, PAPER

# Points shown; browsers turn so many smoothly, and the page stays below about 10 MB, half of it plotly itself.
MOST_POINTS = 200_000
# Diameter of a point on the screen, in pixels.
POINT_SIZE = {2: 2.0, 3: 1.0}
# The page fills the window without bars to scroll it: the wheel is for the map.
PAGE_HEIGHT = "100vh"
PAGE_SCRIPT = "document.body.style.margin = '0'; document.body.style.overflow = 'hidden';"


def write_browser_map(
    path: str | Path,
    points: Float[np.ndarray, "n d"],
    positions: Float[np.ndarray, "k d"],
    unit: str,
    *,
    names: list[str],
) -> None:
    """Write the map as an HTML page that needs no network: in 3D to turn, coloured by height; in 2D to zoom into.

    Parameters
    ----------
    path: a .html file, written whole or not at all.
    points: the merged map ``(n, d)``; at most 200 000 of them, drawn evenly at random, are shown.
    positions: where the sensor was ``(k, d)``, in time order.
    unit: name of the data's unit, for the labels.
    names: k names of the scans, shown where the mouse rests on the path.
    """
    if len(points) > MOST_POINTS:
        chosen = np.random.default_rng(0).choice(len(points), MOST_POINTS, replace=False)
        points = points[np.sort(chosen)]
    figure = go.Figure([_cloud(points, unit), *_path(positions, names)])
    _layout(figure, points.shape[1], unit)
    with atomic_write(path) as temporary:
        config = {"displaylogo": False, "scrollZoom": True}
        figure.write_html(temporary, config=config, default_height=PAGE_HEIGHT, post_script=PAGE_SCRIPT)


def _cloud(points: np.ndarray, unit: str) -> go.Scatter3d | go.Scattergl:
    columns = points.astype(np.float32).T  # half the page, and all that a browser draws with
    size = POINT_SIZE[len(columns)]
    if len(columns) == 2:
        marker = {"size": size, "color": INK}
        return go.Scattergl(x=columns[0], y=columns[1], mode="markers", marker=marker, name="map", hoverinfo="skip")
    low, high = np.quantile(columns[2], HEIGHT_QUANTILES)
    marker = {
        "size": size,
        "color": columns[2],
        "line": {"width": 0},
        "colorscale": "Viridis",
        "cmin": low,
        "cmax": high,
        "colorbar": {"title": f"height ({unit})", "thickness": 12, "len": 0.5},
    }
    x, y, z = columns
    return go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, name="map", hoverinfo="skip")


def _path(positions: np.ndarray, names: list[str]) -> list[go.Scatter3d | go.Scattergl]:
    """The path, and discs where it starts and ends."""
    kind = go.Scatter3d if positions.shape[1] == 3 else go.Scattergl

    def places(rows: slice) -> dict[str, np.ndarray]:
        return dict(zip("xyz", positions[rows].astype(np.float32).T, strict=False))

    line = {"color": ACCENT, "width": 4 if positions.shape[1] == 3 else 2}
    traces = [kind(**places(slice(None)), mode="lines", line=line, name="path", text=names, hoverinfo="text")]
    for name, rows, symbol in (("start", slice(0, 1), "circle"), ("end", slice(-1, None), "square")):
        marker = {"size": 7, "color": PAPER, "symbol": symbol, "line": {"color": INK, "width": 2}}
        traces.append(kind(**places(rows), mode="markers", marker=marker, name=name, text=[name], hoverinfo="text"))
    return traces


def _layout(figure: go.Figure, d: int, unit: str) -> None:
    """Equal axes, and no decoration that hides points."""
    axis = {"backgroundcolor": PAPER, "gridcolor": "#e6e9ec", "zeroline": False, "showspikes": False}
    figure.update_layout(
        template="plotly_white",
        margin={"l": 10, "r": 10, "t": 10, "b": 10},
        legend={"x": 0.01, "y": 0.99, "itemsizing": "constant"},
        dragmode="pan" if d == 2 else "orbit",
    )
    if d == 3:
        axes = {f"{name}axis": {**axis, "title": f"{name} ({unit})"} for name in "xyz"}
        figure.update_scenes(aspectmode="data", **axes)
    else:
        figure.update_xaxes(title=f"x ({unit})", zeroline=False)
        figure.update_yaxes(title=f"y ({unit})", zeroline=False, scaleanchor="x")
