"""What the pictures are made of: figures without global state, coloured paths, marks, scale bars."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import Normal, withStroke

from bbr_layer import atomic_write

# One palette for every picture: ink on paper, and grey for what nobody has seen.
INK, PAPER, UNSEEN, QUIET, ACCENT, SECOND = "#15202b", "#ffffff", "#dce1e6", "#8593a0", "#c8321e", "#1f6f8b"
DPI = 200
# Longer side of a picture's drawing, in inches.
LONG_SIDE = 10.0
# Heights outside these quantiles share the end colours.
HEIGHT_QUANTILES = (0.005, 0.995)
# Share of the drawing's width that a scale bar takes at most.
SCALE_BAR_SHARE = 0.2


def _part_of(name: str, low: float, high: float) -> ListedColormap:
    """Part of a matplotlib colour map: the ends that vanish on white are left out."""
    return ListedColormap(colormaps[name](np.linspace(low, high, 256)), name=f"part of {name}")


TIME_COLOURS = _part_of("plasma", 0.0, 0.85)
HEIGHT_COLOURS = _part_of("viridis", 0.0, 0.92)
ERROR_COLOURS = _part_of("YlOrRd", 0.25, 1.0)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, drawn by Agg; no window and no pyplot state is involved."""
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAPER, layout="compressed")
    FigureCanvasAgg(figure)
    return figure


def save_picture(figure: Figure, path: str | Path) -> None:
    """Write the figure as a .png, cropped to what is drawn, whole or not at all."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI, bbox_inches="tight", pad_inches=0.1)


def plan_axes(axes: Axes, unit: str, names: tuple[str, str] = ("x", "y")) -> None:
    """Equal axes with thin ticks, labelled with the unit."""
    axes.set_aspect("equal")
    axes.set_xlabel(f"{names[0]} ({unit})")
    axes.set_ylabel(f"{names[1]} ({unit})")
    quiet_frame(axes)


def quiet_frame(axes: Axes) -> None:
    """A thin grey frame and small ticks, so that the data speak."""
    axes.tick_params(colors=QUIET, labelcolor=INK, labelsize=8, width=0.6, length=3)
    axes.xaxis.label.set_fontsize(9)
    axes.yaxis.label.set_fontsize(9)
    for spine in axes.spines.values():
        spine.set(color=QUIET, linewidth=0.6)


def coloured_path(
    axes: Axes,
    positions: Float[np.ndarray, "k 2"],
    values: Float[np.ndarray, " k"],
    colours: Colormap,
    *,
    width: float = 2.0,
) -> LineCollection:
    """A path ``(k, 2)`` whose colour follows ``values`` ``(k,)``, on a white casing that lifts it off the map."""
    segments = list(np.stack((positions[:-1], positions[1:]), axis=1))
    low, high = float(values.min()), float(values.max())
    lines = LineCollection(segments, cmap=colours, norm=Normalize(low, high if high > low else low + 1))
    lines.set(array=values[1:], linewidth=width, capstyle="round", zorder=4)
    casing = LineCollection(segments, colors=PAPER, linewidths=width + 1.6, capstyle="round", zorder=3)
    axes.add_collection(casing)
    axes.add_collection(lines)
    return lines


def mark_ends(axes: Axes, positions: Float[np.ndarray, "k 2"]) -> None:
    """A disc where the path ``(k, 2)`` starts and a square where it ends."""
    for (x, y), marker, label in ((positions[0], "o", "start"), (positions[-1], "s", "end")):
        axes.plot(x, y, marker, ms=7, mfc=PAPER, mec=INK, mew=1.8, zorder=6, ls="none", label=label)


def scale_bar(axes: Axes, unit: str) -> None:
    """A bar of a round length with its label, in the lower left corner; the axes' limits must be set."""
    (left, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    width = right - left
    length = round_down(width * SCALE_BAR_SHARE)
    x, y, thickness = left + 0.025 * width, bottom + 0.02 * width, 0.005 * width
    axes.add_patch(Rectangle((x, y), length, thickness, fc=INK, ec=PAPER, lw=0.8, zorder=7))
    label = axes.text(x + length / 2, y + 1.8 * thickness, f"{length:g} {unit}", ha="center", va="bottom")
    label.set(fontsize=9, color=INK, zorder=7, path_effects=[withStroke(linewidth=2.5, foreground=PAPER), Normal()])


def colour_bar(figure: Figure, axes: Axes | list[Axes], coloured: ScalarMappable, label: str) -> None:
    """A thin colour bar beside the axes."""
    bar = figure.colorbar(coloured, ax=axes, shrink=0.5, aspect=28, pad=0.012)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=QUIET, labelcolor=INK, labelsize=8, width=0.6, length=3)
    bar.set_label(label, fontsize=9, color=INK)


def legend(axes: Axes) -> None:
    """The axes' legend in the upper right corner, in small type."""
    shown = axes.legend(loc="upper right", fontsize=8, frameon=True, framealpha=0.85, edgecolor="none")
    shown.set_zorder(8)


def round_down(length: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not above ``length`` (positive)."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(step * power for step in (5, 2, 1) if step * power <= length * (1 + 1e-9)))
