"""The trajectory with its errors over time, and the curves of a training."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter
from scipy.spatial.transform import Rotation

from train.drawing import (
    ACCENT,
    ERROR_COLOURS,
    INK,
    LONG_SIDE,
    QUIET,
    SECOND,
    TIME_COLOURS,
    colour_bar,
    coloured_path,
    legend,
    mark_ends,
    new_figure,
    plan_axes,
    quiet_frame,
    scale_bar,
)
from train.evaluate import align_trajectories, pose_errors
from train.poses import embed_poses

# Height of one panel of curves, in inches, and panels side by side.
PANEL = 1.7
PANELS_ACROSS = 3
# Share of the path's longer side left free around it.
MARGIN = 0.06
# The flattest and the tallest plan that is drawn, height over width: a straight road would be a line otherwise.
FLATTEST, TALLEST = 0.25, 0.75
# Free space above a curve, for its legend; below NOTHING (any unit) a curve is rounding and drawn flat.
HEADROOM = 1.3
NOTHING = 1e-9
# A loss that only falls by less than this factor is clearer on a linear axis.
LOG_FACTOR = 20.0


def trajectory_picture(
    estimate: Float[np.ndarray, "k m m"],
    truth: Float[np.ndarray, "k m m"] | None,
    unit: str,
    *,
    loops: Sequence[tuple[int, int]] = (),
) -> Figure:
    """The path from above and, below it, curves over the scans.

    With ``truth``, which is carried into the map's frame (aligned as for APE), the path is coloured by its position
    error. Without, by time, and the curves are the step and the turn from scan to scan: a lost track is a spike.

    Parameters
    ----------
    estimate, truth: ``world_from_scan`` ``(k, 3, 3)`` or ``(k, 4, 4)``.
    unit: name of the data's unit, for the labels.
    loops: pairs of scans joined by a loop closure, drawn as thin lines.
    """
    poses = embed_poses(estimate)
    path, colouring, colours = poses[:, :2, 3], np.arange(len(poses), dtype=float), TIME_COLOURS
    names, curves, shown = (f"step ({unit})", "turn (deg)"), _steps(poses), path
    if truth is not None:
        names, curves = (f"position error ({unit})", "rotation error (deg)"), pose_errors(estimate, truth)
        colouring, colours = curves[0], ERROR_COLOURS
        there = np.linalg.solve(align_trajectories(estimate, truth), embed_poses(truth))[:, :2, 3]
        shown = np.concatenate((path, there))
    figure, plan, panels = _layout(shown)
    for a, b in loops:
        plan.plot(*path[[a, b]].T, color=SECOND, lw=0.5, alpha=0.5, zorder=2)
    if truth is not None:
        plan.plot(*there.T, color=INK, lw=1.0, ls=(0, (4, 2)), zorder=5, label="truth")
    drawn = coloured_path(plan, path, colouring, colours, width=3.0)
    mark_ends(plan, path)
    plan_axes(plan, unit)
    scale_bar(plan, unit)
    legend(plan)
    colour_bar(figure, plan, drawn, "scan" if truth is None else names[0])
    _draw_curves(panels, dict(zip(names, curves, strict=True)), typical=truth is not None)
    return figure


def losses_picture(losses: Mapping[str, Sequence[float]]) -> Figure:
    """One panel per loss over the epochs, on a logarithmic axis where it falls far and stays positive.

    All curves end at the same epoch; those that hold one value more begin with the state before the first.
    """
    epochs = min((len(curve) for curve in losses.values()), default=0)
    columns = 2 if len(losses) == 4 else min(len(losses), PANELS_ACROSS)
    rows = -(-len(losses) // columns)
    figure = new_figure(LONG_SIDE * columns / PANELS_ACROSS + 0.5, 1.4 * PANEL * rows + 0.3)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, (name, curve) in zip(panels, losses.items(), strict=False):
        values = np.asarray(curve, dtype=float)
        axes.plot(
            np.arange(epochs - len(values), epochs) + 1,
            values,
            color=SECOND,
            lw=1.4,
            marker="o" if len(values) < 3 else "",
        )
        usable = values[np.isfinite(values)]
        if len(usable) and usable.min() > 0 and usable.max() > LOG_FACTOR * usable.min():
            axes.set_yscale("log")
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_title(name, fontsize=10, color=INK)
        axes.set_xlabel("epoch")
        axes.grid(color=QUIET, alpha=0.25, lw=0.5)
        quiet_frame(axes)
    for axes in panels[len(losses) :]:
        axes.set_visible(False)
    return figure


def _layout(shown: np.ndarray) -> tuple[Figure, Axes, Sequence[Axes]]:
    """A plan whose limits hold the positions ``(n, 2)`` and, under it, two panels of curves."""
    low, high = shown.min(axis=0), shown.max(axis=0)
    width, depth = high - low if np.any(high > low) else (1.0, 1.0)
    size = (1 + 2 * MARGIN) * np.array([max(width, depth / TALLEST), max(depth, width * FLATTEST)])
    height = LONG_SIDE * size[1] / size[0]
    figure = new_figure(LONG_SIDE + 1.0, height + 2 * PANEL + 0.8)
    plan, *panels = figure.subplots(3, 1, height_ratios=(height, PANEL, PANEL))
    middle = (low + high) / 2
    plan.set_xlim(middle[0] - size[0] / 2, middle[0] + size[0] / 2)
    plan.set_ylim(middle[1] - size[1] / 2, middle[1] + size[1] / 2)
    panels[0].sharex(panels[1])
    panels[0].tick_params(labelbottom=False)
    return figure, plan, panels


def _steps(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Length (data's unit) and turn (degrees) from each scan to the next; 0 at the first."""
    moves = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, prepend=poses[:1, :3, 3]), axis=1)
    orientation = Rotation.from_matrix(poses[:, :3, :3])
    turns = (orientation[:-1].inv() * orientation[1:]).magnitude() if len(poses) > 1 else np.zeros(0)
    return moves, np.rad2deg(np.concatenate(([0.0], turns)))


def _draw_curves(panels: Sequence[Axes], curves: Mapping[str, np.ndarray], *, typical: bool) -> None:
    for axes, (name, values) in zip(panels, curves.items(), strict=True):
        _curve(axes, values, name, typical=typical)
    panels[-1].set_xlabel("scan")


def _curve(axes: Axes, values: np.ndarray, name: str, *, typical: bool) -> None:
    """One curve over the scans, filled down to zero; ``typical`` adds its root mean square as a line."""
    scans = np.arange(len(values))
    axes.fill_between(scans, values, color=SECOND, alpha=0.18, lw=0)
    axes.plot(scans, values, color=SECOND, lw=1.2)
    if typical:
        rms = float(np.sqrt(np.mean(values**2)))
        axes.axhline(rms, color=ACCENT, lw=0.9, ls=(0, (4, 2)), label=f"root mean square {rms:.3g}")
        legend(axes)
    axes.set_ylabel(name)
    axes.set_ylim(0, HEADROOM * max(float(np.max(values)), NOTHING))
    axes.margins(x=0.01)
    axes.grid(color=QUIET, alpha=0.25, lw=0.5)
    quiet_frame(axes)
