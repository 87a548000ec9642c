"""The paper's figures, drawn anew from the results: ours, the paper's variants and the peers under both samplings."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullLocator
from PIL import Image

from bbr_layer import atomic_write
from benchmarks.paper_methods import METHODS, Method
from benchmarks.paper_results import Bench, Scores
from train.drawing import ACCENT, INK, PAPER, QUIET, SECOND, new_figure, quiet_frame, save_picture

# Colour and width: of two that end alike the wider one lies below.
OURS = {"BBRLayer()": (INK, 3.4), "BBRLayer.fast()": ("#e07b00", 1.5), "BBRLayer.robust()": (ACCENT, 1.5)}
VARIANTS = dict(zip(("softBBS", "softBD", "N", "F"), ("#c9a227", "#b9770e", "#7d5a9b", SECOND), strict=True))
PEERS = ("#2a9d8f", "#8ab17d", "#457b9d", "#9c89b8", "#b56576", "#6c757d", "#d18f5b")
MARKERS = "os^vDPX"
FLOOR_DEG = 0.01  # the lowest error drawn: an error of 0 has no place on a logarithmic axis
COLOURS = 48  # of a picture
PANEL = (2.4, 1.85)  # inches
FARTHEST_DEG = 6.0  # cumulative curves are drawn at least so far: beyond what counts as failed
THRESHOLDS = 300


def draw(benches: list[Bench], folder: Path) -> None:
    """``paper_figN.png`` of one experiment; nothing where nothing was run, and no picture of the lidar tables."""
    shown = [bench for bench in benches if bench.known_cells()]
    if not shown or shown[0].experiment.name == "lidar":
        return
    name = shown[0].experiment.name
    figure = {"fig2": _turns, "fig6": _cumulative, "fig7": _cumulative}.get(name, _accuracy)(shown)
    _save(figure, folder / f"paper_{name}.png")


def _save(figure: Figure, path: Path) -> None:
    """As the mapper's pictures, in so few colours that the file stays small."""
    save_picture(figure, path)
    with Image.open(path) as image, atomic_write(path) as temporary:
        image.convert("RGB").quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
            temporary, optimize=True
        )


def _turns(benches: list[Bench]) -> Figure:
    """Fig. 2: failures, and median error of what did not fail, against the initial rotation."""
    panels = list(dict.fromkeys(cell.panel for cell in benches[0].known_cells()))
    figure, grid = _grid(2 * len(benches), len(panels))
    for row, bench in enumerate(benches):
        for column, panel in enumerate(panels):
            failed, accurate = grid[2 * row, column], grid[2 * row + 1, column]
            for method in METHODS:
                x, found = _series(bench, method, panel)
                experiment = bench.experiment
                failed.plot(x, [s.failed(experiment) / len(s.degrees) for s in found], **_style(method))
                good = [s.degrees[s.degrees <= experiment.failed_deg] for s in found]
                accurate.plot(x, [np.median(g) if len(g) else np.nan for g in good], **_style(method))
            failed.set_title(f"{panel}, {bench.sampling}", fontsize=9, color=INK)
            failed.set_ylim(-0.03, 1.03)
            _logarithmic(accurate)
            accurate.set_xlabel(bench.experiment.axis)
            if column == 0:
                failed.set_ylabel("share that failed")
                accurate.set_ylabel("median of the rest (deg)")
    return _named(figure, grid)


def _accuracy(benches: list[Bench]) -> Figure:
    """Figs. 3 to 5: median rotation and translation errors against the number of points."""
    panels = list(dict.fromkeys(cell.panel for cell in benches[0].known_cells()))
    beside = len(panels) == 1  # one object: the samplings stand side by side, else one below the other
    figure, grid = _grid(2 if beside else 2 * len(benches), len(benches) if beside else len(panels))
    for number, bench in enumerate(benches):
        for place, panel in enumerate(panels):
            row, column = (0, number) if beside else (2 * number, place)
            turned, shifted = grid[row, column], grid[row + 1, column]
            for method in METHODS:
                x, found = _series(bench, method, panel)
                turned.plot(x, [max(np.median(s.degrees), FLOOR_DEG) for s in found], **_style(method))
                shifted.plot(x, [1000 * np.median(s.shifts) for s in found], **_style(method))
            turned.set_title(f"{panel}, {bench.sampling}", fontsize=9, color=INK)
            shifted.set_xlabel(bench.experiment.axis)
            _logarithmic(turned)
            _logarithmic(shifted)
            if column == 0:
                turned.set_ylabel("median error (deg)")
                shifted.set_ylabel("median error (mm)")
    return _named(figure, grid)


def _logarithmic(axes: Axes) -> None:
    """A logarithmic axis with plain numbers, and not only powers of ten."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_locator(NullLocator())


def _cumulative(benches: list[Bench]) -> Figure:
    """Figs. 6 and 7: the share of registrations below an error."""
    figure, grid = _grid(1, len(benches), scale=1.5)
    for axes, bench in zip(grid[0], benches, strict=True):
        (cell,) = bench.known_cells()
        errors = {m.name: found.degrees for m in METHODS if (found := bench.scores(m, cell.name))}
        everything = np.concatenate(list(errors.values()))
        thresholds = np.geomspace(0.8 * everything.min(), max(1.2 * everything.max(), FARTHEST_DEG), THRESHOLDS)
        for method in METHODS:
            if method.name in errors:
                share = (errors[method.name][:, None] <= thresholds).mean(0)
                axes.plot(thresholds, share, **_style(method) | {"marker": ""})
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_ylim(-0.02, 1.02)
        axes.axvline(bench.experiment.failed_deg, color=QUIET, lw=0.6, ls=":")
        axes.set_title(f"{cell.panel}, {bench.sampling}", fontsize=9, color=INK)
        axes.set_xlabel("error (deg)")
    grid[0, 0].set_ylabel("share below")
    return _named(figure, grid)


def _grid(rows: int, columns: int, scale: float = 1.0) -> tuple[Figure, np.ndarray]:
    figure = new_figure(PANEL[0] * scale * columns, PANEL[1] * scale * rows + 0.5)
    grid: np.ndarray = figure.subplots(rows, columns, squeeze=False, sharex="col")
    for axes in grid.flat:
        quiet_frame(axes)
    return figure, grid


def _series(bench: Bench, method: Method, panel: str) -> tuple[list[float], list[Scores]]:
    """Where along the axis a method was run, and what came of it."""
    cells = [cell for cell in bench.known_cells() if cell.panel == panel]
    known = [(cell.x, found) for cell in cells if (found := bench.scores(method, cell.name)) is not None]
    return [x for x, _ in known], [found for _, found in known]


def _style(method: Method) -> dict[str, object]:
    """Ours thick, the paper's variants dashed, the peers thin with markers."""
    if method.kind == "variant":
        return {"color": VARIANTS[method.name.removeprefix("paper ")], "ls": "--", "lw": 1.2, "label": method.name}
    if method.kind == "ours":
        colour, width = OURS.get(method.name, (QUIET, 1.5))
        return {"color": colour, "lw": width, "label": method.name, "zorder": 5}
    number = [x.name for x in METHODS if x.kind == "peer"].index(method.name)
    marks = {"marker": MARKERS[number], "ms": 3.5, "mec": PAPER, "mew": 0.4}
    return {"color": PEERS[number], "lw": 0.9, "label": method.name, **marks}


def _named(figure: Figure, grid: np.ndarray) -> Figure:
    """One legend for all panels, below them, of the lines that hold anything."""
    lines: dict[str, object] = {}
    for axes in grid.flat:
        assert isinstance(axes, Axes)
        lines |= {str(line.get_label()): line for line in axes.get_lines() if len(np.atleast_1d(line.get_xdata())) > 0}
    shown = {name: line for name, line in lines.items() if not name.startswith("_")}
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    return figure
