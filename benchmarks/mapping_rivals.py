"""How far off are the maps of other people's tools on the sequences of the table of maps, and on simulated plans?

    python -m benchmarks.mapping_rivals [--only v1_pose0 "plan 3" ...] [--rivals KISS-ICP ...]

Needs ``pip install -e '.[peers]'``. Our own figures on the sequences are read from ``benchmarks/mapping_table.md``; the
simulated plans are mapped here. Every result is kept in ``out/benchmark/mapping_rivals.json`` and not measured again.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from bbr_layer import atomic_write
from benchmarks.map_rivals import gicp, kiss, multiway, point_to_line
from benchmarks.map_rivals.chain import PLAIN, Solutions
from benchmarks.map_rivals.floor_plans import FLOOR_PLANS
from benchmarks.map_rivals.table import (
    ERROR,
    OURS,
    SECONDS,
    Results,
    lacking,
    own_figures,
    seconds_of,
    standing,
    summary_of,
    table_of,
)
from benchmarks.mapping_rows import PIXELS, ROWS, Row
from benchmarks.mapping_table import map_errors, measured
from train.scans import ScanSet

ALL_ROWS = ROWS | FLOOR_PLANS
KEPT = Path("out", "benchmark", "mapping_rivals.json")
OWN = Path("benchmarks", "mapping_table.md")


class Rival(NamedTuple):
    """``solve(scans, setting, progress)``, and by dimension the settings with their words."""

    solve: Callable[..., Solutions]
    settings: dict[int, dict[str, Any]]


def _gicp(kind: str) -> Rival:
    words = {f"voxel {x.voxel:g}, gates {x.gates}, {_begin(x.follow)}": x for x in gicp.SETTINGS}
    return Rival(lambda scans, setting, told: gicp.solved(scans, kind, setting, told), {2: words, 3: words})


def _begin(follow: bool) -> str:
    return "from the last motion" if follow else "from in place"


def _voxels(*shares: float) -> dict[str, float]:
    return {f"voxel {share:g}": share for share in shares}


MULTIWAY = [multiway.Setting(0.02, (0.5,)), multiway.Setting(0.02, (2.0, 0.7)), multiway.Setting(0.05, (0.75,))]
LINES = {f"widest gate {gate:g}, {_begin(go)}": (gate, go) for gate, go in ((0.4, False), (0.8, True))}
RIVALS = {
    "KISS-ICP": Rival(kiss.solved, {2: _voxels(0.07, 0.1, 0.14, 0.2), 3: _voxels(0.02, 0.05, 0.1)}),
    "small_gicp GICP": _gicp("GICP"),
    "small_gicp point-to-plane": _gicp("PLANE_ICP"),
    "Open3D multiway": Rival(multiway.solved, {3: {f"voxel {x.voxel:g}, gates {x.gates}": x for x in MULTIWAY}}),
    "point-to-line": Rival(point_to_line.solved, {2: LINES}),
}
HEAD = """\
Made by `python -m benchmarks.mapping_rivals` on one thread. The error is the row's own of
`benchmarks/mapping_table.md`: RMSE of the positions after rigid alignment; of the points for the kitchen, the bunny and
the dragon. Ours on the sequences is read from there, at the one default configuration. **Each rival gets, row by row,
the better of its settings, chosen with the truth, which flatters it.** Bold: the least error of the row. No starting
poses are given to anyone. "yaw starts": pairs of a poor overlap are sought again turned by 30, 60 and 90 degrees either
way; "feature starts": all pairs also by RANSAC on FPFH features; of several answers the larger overlap stays.
"""


def solved(row: Row, scans: ScanSet, rival: Rival, setting: Any, told: Callable) -> dict[str, dict[str, float]]:
    """By kind of start: the row's own error, degrees, and the seconds until then."""
    begin, spent, found = time.process_time(), 0.0, {}
    for start, poses in rival.solve(scans, setting, told):
        spent += time.process_time() - begin
        finite = bool(np.isfinite(poses).all())
        errors = map_errors(poses, scans, row) if finite else {row.error: np.inf, "degrees": np.inf}
        found[start] = {ERROR: errors[row.error], "degrees": errors["degrees"], SECONDS: spent}
        begin = time.process_time()
    return found


def measure(name: str, only: list[str], settings: tuple[str, ...], results: Results) -> None:
    """Fill in what the results lack of one row, of some rivals and settings, and keep them after each setting."""
    row = ALL_ROWS[name]
    held, scans = results.setdefault(name, {}), row.make()
    if name in FLOOR_PLANS and OURS not in held:
        own = measured(row)
        held[OURS] = {"default": {PLAIN: {ERROR: own[row.error], **{x: own[x] for x in ("degrees", SECONDS)}}}}
        _keep(results)
    for title, rival in RIVALS.items():
        if only and title not in only:
            continue
        for words, setting in rival.settings.get(scans.dimension, {}).items():
            if words in held.setdefault(title, {}) or not words.startswith(settings):
                continue
            held[title][words] = solved(row, scans, rival, setting, partial(_tell, name, title))
            shown = ", ".join(f"{start} {found[ERROR]:.3g}" for start, found in held[title][words].items())
            print(f"\r{name} | {title} | {words} | {shown}", flush=True)
            _keep(results)


def _tell(name: str, title: str, stage: str, done: int, total: int) -> None:
    print(f"\r{name} | {title} | {stage} {done}/{total}   ", end="", flush=True)


def _keep(results: Results) -> None:
    KEPT.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(KEPT) as temporary:
        temporary.write_text(json.dumps(results, indent=1))


def document(results: Results) -> str:
    """All tables, of what was measured so far."""
    own = own_figures(OWN)
    merged = {row: _ordered(own.get(row, {}) | results[row]) for row in ALL_ROWS if row in results}
    merged = {row: held for row, held in merged.items() if OURS in held}
    units = {name: row.unit.name for name, row in ALL_ROWS.items()}
    flat = [row for row in merged if row.startswith("v1_pose0")]
    plans = [row for row in merged if row in FLOOR_PLANS]
    lines = [HEAD]
    for title, rows in (
        ("In the plane", flat),
        ("In space", [row for row in merged if row not in flat and row not in plans]),
        ("Simulated floor plans (`benchmarks/map_rivals/floor_plans.py`)", plans),
    ):
        if rows:
            lines += [f"## {title}", "", standing(merged, rows), "", *table_of(merged, rows, units), ""]
            lines += ["CPU seconds at the chosen settings, without further starts:", "", *seconds_of(merged, rows), ""]
    groups = {f"movers {share} %": [row for row in flat if f"movers {share} %" in row] for share in (20, 40)}
    groups |= {"plans": plans, "plans with movers": [row for row in plans if "movers" in row]}
    groups = {name: rows for name, rows in groups.items() if rows}
    lines += ["## Medians and worst", "", *summary_of(merged, groups, units), "", *_settings(), "", *_not_run(results)]
    return "\n".join(lines).rstrip() + "\n"


def _ordered(held: dict[str, Any]) -> dict[str, Any]:
    return {title: held[title] for title in (OURS, *RIVALS) if title in held}


def _settings() -> list[str]:
    lines = [
        "## Settings",
        "",
        "Lengths as shares of the scans' reach, the median distance of the points of a scan from",
    ]
    lines += ["their middle; the planar scans of small_gicp are drawn out into low walls.", ""]
    for title, rival in RIVALS.items():
        for dimension, settings in rival.settings.items():
            lines.append(f"- {title}, {dimension}D: " + "; ".join(settings))
    return lines


def _not_run(results: Results) -> list[str]:
    wanted = {}
    for name in results:
        dimension = 2 if ALL_ROWS[name].unit is PIXELS or name in FLOOR_PLANS else 3
        wanted[name] = {title: list(rival.settings.get(dimension, {})) for title, rival in RIVALS.items()}
    lines = lacking(results, wanted)
    note = "There a figure is missing, or a better one of a rival could be."
    return ["## Not run, for want of time", "", note, "", *lines] if lines else []


def main() -> None:
    """Measure the rows asked for and write the table after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], help="rows that begin with one of these")
    parser.add_argument("--rivals", nargs="+", default=[], choices=list(RIVALS), help="these rivals; all without it")
    parser.add_argument("--settings", nargs="+", default=[""], help="settings that begin with one of these")
    parser.add_argument("--out", type=Path, default=Path("benchmarks", "mapping_rivals.md"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    results: Results = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    for name in (name for name in ALL_ROWS if name.startswith(tuple(options.only))):
        measure(name, options.rivals, tuple(options.settings), results)
        with atomic_write(options.out) as temporary:
            temporary.write_text(document(results))


if __name__ == "__main__":
    main()
