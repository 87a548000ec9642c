"""What the command line shows: progress while it works, and where everything is when it is done."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from train.evaluate import evaluate_trajectory
from train.keep_best import SCORE
from train.mapping import Mapped
from train.scans import Progress as Report
from train.training import Stopped

# The exit code that command lines give to wrong arguments.
BAD_INPUT = 2
# Where there is no terminal, a stage that goes on is told of again after so many seconds: a log is read, not watched.
SECONDS_APART = 10.0
# What a person looks for in the folder of a map, in this order; files that a run did not write are left out.
SHOWN = {
    "trajectory": ("poses_tum.txt", "poses_kitti.txt", "poses.npz"),
    "map": ("map.ply", "map.html", "occupancy.yaml"),
    "pictures": ("trajectory.png", "map.png", "occupancy.png", "occupancy_network.png", "losses.png"),
    "report": ("metrics.json", "config.yaml"),
}


@dataclass(frozen=True)
class PrintedUnit:
    """Lengths are printed as ``scale`` times the data's, followed by ``name``."""

    scale: float = 1.0
    name: str = ""

    @property
    def of_files(self) -> str:
        """The unit of the data itself, for the labels of pictures: unknown where printing rescales."""
        return self.name if self.name and self.scale == 1 else "units"

    def length(self, value: float) -> str:
        """Four digits and the name of the unit."""
        return f"{value * self.scale:.4g} {self.name}".rstrip()


@contextmanager
def one_sentence() -> Iterator[None]:
    """What is wrong with the input in one sentence on stderr and exit code 2, without a traceback.

    A signal that stops the training is told of too, with the exit code that a shell gives it.
    """
    try:
        yield
    except (ValueError, OSError) as error:
        typer.echo(f"Error: {error}", err=True)
        raise typer.Exit(BAD_INPUT) from error
    except Stopped as stopped:
        typer.echo(str(stopped), err=True)
        raise


@contextmanager
def shown_progress(console: Console) -> Iterator[Report]:
    """A bar for each stage of the work, lines where there is no terminal; yields what is to be told."""
    if not console.is_terminal:
        yield _in_lines(console)
        return
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield report


def _in_lines(console: Console) -> Report:
    """A line when a stage begins, and one every ten seconds while the work goes on."""
    begun = last = time.monotonic()
    told = set()

    def report(stage: str, done: int, total: int) -> None:
        nonlocal last
        now = time.monotonic()
        if stage not in told or now - last >= SECONDS_APART:
            told.add(stage)
            last = now
            console.print(f"{now - begun:6.0f} s  {stage} {done}/{total}", highlight=False)

    return report


def show_map(console: Console, out: Path, mapped: Mapped, unit: PrintedUnit) -> None:
    """What was done to the scans, which epoch was kept, the errors where there is a truth, and the files."""
    for note in mapped.result.scans.notes:
        console.print(f"Note: {note}.", soft_wrap=True, highlight=False, markup=False)
    curve = mapped.result.losses.get(SCORE, [])
    if curve:
        adjusted = mapped.kept_epoch == 0 and not np.allclose(
            mapped.start.matrix.numpy(), mapped.result.world_from_scan, rtol=0, atol=1e-9
        )
        console.print(_kept_sentence(mapped.kept_epoch, curve, adjusted))
    truth = mapped.result.scans.truth
    if truth is not None:
        before = evaluate_trajectory(mapped.start.matrix.numpy(), truth)
        show_metrics(console, evaluate_trajectory(mapped.result.world_from_scan, truth), unit, before)
    for title, names in SHOWN.items():
        found = [str(out / name) for name in names if (out / name).exists()]
        if found:
            _print_verbatim(console, f"{title:<11}" + "\n           ".join(found))


def show_metrics(
    console: Console, metrics: Mapping[str, float], unit: PrintedUnit, before: Mapping[str, float] | None = None
) -> None:
    """A line for each number; ``before``: the same of the map before the training."""
    for name in metrics:
        shown, earlier = (_printed(name, m.get(name), unit) for m in (metrics, before or {}))
        _print_verbatim(console, f"{name:<26}{shown}" + (f"   (edges' map {earlier})" if earlier else ""))


def _print_verbatim(console: Console, text: str) -> None:
    """As it is: names of files and units may hold what rich takes for markup, such as ``[a]``."""
    console.print(Text(text), soft_wrap=True, highlight=False)


def _printed(name: str, value: float | None, unit: PrintedUnit) -> str:
    if value is None:
        return ""
    return f"{value:.4g} deg" if name.endswith("_deg") else unit.length(value)


def _kept_sentence(kept_epoch: int, curve: list[float], adjusted: bool) -> str:
    """``adjusted``: the first map is not that of the edges but adjusted to all scans at once."""
    epochs, first = len(curve) - 1, "the edges' map" + adjusted * ", adjusted to all scans at once"
    if kept_epoch == 0:
        return f"Kept {first}: no epoch of {epochs} scores better ({curve[0]:.4f})."
    return f"Kept epoch {kept_epoch} of {epochs}: score {curve[kept_epoch]:.4f}, the starting map {curve[0]:.4f}."
