"""The tables of the paper's experiments, in one document that also says where other methods are better."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bbr_layer import atomic_write
from benchmarks.lidar import processor
from benchmarks.paper_experiments import LIDAR_POINTS
from benchmarks.paper_losses import where_we_lose
from benchmarks.paper_methods import FEATURE_POINTS, METHODS, Method
from benchmarks.paper_results import CHOOSING, Bench, Scores
from benchmarks.paper_trials import LIDAR_UNIT

HEAD = """# The paper's experiments, beside today's peers

Made by `python -m benchmarks.paper --peers` on one thread of {machine}; the peers want `pip install '.[peers]'`. All
methods see the same trials. The set-ups are the paper's (section 4); `benchmarks/paper_experiments.py` has them, and
what the paper leaves open.

- **Samplings.** *shared*: source and target are drawn from the same points and come with normals of the full cloud (13
  neighbours, lidar 94), as in the paper; this flatters everyone. *disjoint*: no point is shared and every method
  estimates normals from the sample it gets. Two scans share no point either way; there *shared* means the full scans'
  normals.
- **Errors.** Degrees between the rotations; translation is how far from its place the source's centroid ends, so that
  no error depends on where the origin lies. **Failed**: over 5 degrees; for lidar over 1 degree or 0.2 m.
- **Cells** are median / 90th percentile in degrees, failures included, and in brackets how many failed, where any did.
  The lowest median of all but the paper's variants is bold. **s** is processor seconds per registration in the last
  column's trials, normals and trees included where the method makes them.
- **Repeats**: {repeats} per cell, {twice} in Figs. 6 and 7, {half} per lidar pair. The paper's own variants,
  `BBRLayer.paper(...)`, take seconds each: at most {variants} repeats, in some experiments only, with shared sampling
  and at most 500 points; their brackets say how many.
- **Ours**: `BBRLayer()`, `BBRLayer.fast()` and `BBRLayer.robust()` without any argument; on lidar also
  `BBRLayer("F")`, the paper's loss alone. Lidar scans are thinned to {all} points as in the paper, for FPFH + RANSAC
  to {features}.
- **Peers** run at the better of two settings, chosen for each experiment and sampling on {chosen} other seeds per cell
  (lidar: half as many): fewest failures, then lowest errors. They begin where our layer begins: in place or centroid on
  centroid, whichever lies better. Their unit is the point spacing, on lidar {unit:g} m. GICP and VGICP find their own
  normals, as in the paper. FPFH + RANSAC ends with the narrow run of Open3D's symmetric ICP.
"""
MISSING = "-"


def document(benches: list[Bench], path: Path) -> None:
    """Write everything that was run."""
    first = benches[0]
    head = HEAD.format(
        machine=processor(),
        repeats=first.repeats,
        twice=2 * first.repeats,
        half=first.repeats // 2,
        all=LIDAR_POINTS,
        features=FEATURE_POINTS,
        variants=first.variant_repeats,
        chosen=CHOOSING,
        unit=LIDAR_UNIT,
    )
    parts = [head, *where_we_lose(benches)]
    names = dict.fromkeys(bench.experiment.name for bench in benches)
    for name in names:
        alike = [x for x in benches if x.experiment.name == name]
        parts += ["", f"## {alike[0].experiment.title}", ""]
        if name != "lidar" and any(x.known_cells() for x in alike):
            parts += [f"![{alike[0].experiment.title}](paper_{name}.png)"]
        parts += ["", alike[0].experiment.note] if alike[0].experiment.note else []
        for bench in sorted(alike, key=lambda x: x.sampling, reverse=True):
            parts += _tables(bench)
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join([*parts, "", *_settings(benches)]) + "\n", encoding="utf-8")


def _tables(bench: Bench) -> Iterator[str]:
    for panel in dict.fromkeys(cell.panel for cell in bench.known_cells()):
        cells = [cell for cell in bench.known_cells() if cell.panel == panel]
        yield from ("", f"### {panel}, {bench.sampling}", "")
        if bench.experiment.name == "lidar":
            yield "| method | failed | mean deg | max deg | mean m | max m | s |"
            yield "|---|---|---|---|---|---|---|"
        else:
            yield f"| {bench.experiment.axis} | " + " | ".join(f"{cell.x:g}" for cell in cells) + " | s |"
            yield "|---" * (len(cells) + 2) + "|"
        found = [[bench.scores(method, cell.name) for cell in cells] for method in METHODS]
        rivals = [scores for method, scores in zip(METHODS, found, strict=True) if method.kind != "variant"]
        best = [_lowest([scores[k] for scores in rivals]) for k in range(len(cells))]
        for method, scores in zip(METHODS, found, strict=True):
            known = [x for x in scores if x is not None]
            if known and bench.experiment.name == "lidar":
                yield _lidar_row(bench, method, known[0])
            elif known:
                yield _row(bench, method, scores, best)


def _lowest(scores: list[Scores | None]) -> float:
    return min((float(np.median(x.degrees)) for x in scores if x is not None), default=np.nan)


def _row(bench: Bench, method: Method, scores: list[Scores | None], best: list[float]) -> str:
    cells = []
    for found, lowest in zip(scores, best, strict=True):
        if found is None:
            cells.append(MISSING)
            continue
        median, high = np.median(found.degrees), np.quantile(found.degrees, 0.9)
        bold = "**" if median == lowest and method.kind != "variant" else ""
        failed = found.failed(bench.experiment)
        words = f"{failed} of {len(found.degrees)}" if method.kind == "variant" else f"{failed}" if failed else ""
        cells.append(f"{bold}{median:.3f}{bold} / {high:.3f}" + (f" ({words})" if words else ""))
    seconds = next(np.mean(x.seconds) for x in reversed(scores) if x is not None)
    return f"| {method.name} | " + " | ".join([*cells, f"{seconds:.2f}"]) + " |"


def _lidar_row(bench: Bench, method: Method, x: Scores) -> str:
    cells = [f"{x.failed(bench.experiment)}/{len(x.degrees)}", f"{x.degrees.mean():.3f}", f"{x.degrees.max():.3f}"]
    cells += [f"{x.shifts.mean():.3f}", f"{x.shifts.max():.3f}", f"{x.seconds.mean():.2f}"]
    return f"| {method.name} | " + " | ".join(cells) + " |"


def _settings(benches: list[Bench]) -> Iterator[str]:
    """Which of its two settings each peer had, where."""
    yield from ("## Settings of the peers", "", "All lengths in point spacings.", "")
    yield "| peer | experiment, sampling: setting |"
    yield "|---|---|"
    for method in METHODS:
        if len(method.settings) > 1:
            where: dict[str, list[str]] = {}
            for bench in benches:
                if bench.known_cells():
                    where.setdefault(bench.chosen(method), []).append(f"{bench.experiment.name} {bench.sampling}")
            words = "; ".join(f"{', '.join(places)}: **{setting}**" for setting, places in where.items())
            yield f"| {method.name} | {words} |"
