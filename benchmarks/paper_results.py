"""Runs what is missing of an experiment, and keeps every registration's errors and seconds in one file."""

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bbr_layer import atomic_write
from benchmarks.paper_experiments import Cell, Experiment
from benchmarks.paper_methods import Method, runs_in

CHOOSING, CHOSEN_FROM = 4, 1000  # settings are chosen on so many seeds from this one; the figures are of seeds from 0
TURNED_ROUND = 180.0  # degrees of error of an answer that is not finite


SMALLEST = 1e-9  # degrees and data units: errors below are alike
FAILED_DEG = 5.0  # an answer that is farther off has failed


def spread(degrees: np.ndarray) -> str:
    """Median / 90th percentile, and in brackets how many failed, where any did."""
    middle, high = np.quantile(degrees, (0.5, 0.9))
    failed = int((degrees > FAILED_DEG).sum())
    return f"{middle:.3f} / {high:.3f}" + f" ({failed})" * bool(failed)


class Scores(NamedTuple):
    """The registrations of one method in one cell, in order of their seeds: arrays ``(k,)``."""

    degrees: np.ndarray
    shifts: np.ndarray
    seconds: np.ndarray

    def failed(self, experiment: Experiment) -> int:
        """How many ended too far off."""
        return int(((self.degrees > experiment.failed_deg) | (self.shifts > experiment.failed_shift)).sum())


class Results:
    """Errors by place (experiment, sampling, cell), method with its setting, and seed; on disk whole or not at all."""

    def __init__(self, path: Path):
        self.path = path
        self.warmed: set[tuple[str, int]] = set()
        self.kept: dict[str, dict[str, dict[str, list[float]]]] = json.loads(path.read_text()) if path.exists() else {}

    def of(self, place: str, name: str) -> dict[str, list[float]]:
        """By seed; empty where nothing was run."""
        return self.kept.get(place, {}).get(name, {})

    def add(self, place: str, name: str, found: dict[str, list[float]]) -> None:
        """Keep more registrations, and write the file."""
        self.kept.setdefault(place, {}).setdefault(name, {}).update(found)
        with atomic_write(self.path) as temporary:
            temporary.write_text(json.dumps(self.kept), encoding="utf-8")

    def scores(self, place: str, name: str, seeds: Iterable[int]) -> Scores | None:
        """Those of the seeds that were run, or None."""
        found = self.of(place, name)
        rows = [found[str(seed)] for seed in seeds if str(seed) in found]
        return Scores(*np.array(rows).T) if rows else None


class Known(NamedTuple):
    """A cell as the results name it."""

    panel: str
    x: float

    @property
    def name(self) -> str:
        """As ``Cell.name``."""
        return f"{self.panel} {self.x:g}"


class Bench(NamedTuple):
    """One experiment under one sampling with the results it is read from and written to."""

    results: Results
    experiment: Experiment
    sampling: str
    repeats: int
    variant_repeats: int

    def place(self, cell: str) -> str:
        """Under which name a cell's results are kept."""
        return f"{self.experiment.name}, {self.sampling}, {cell}"

    def seeds(self, method: Method) -> range:
        """Of a method's registrations in each cell."""
        if method.kind == "variant":
            return range(self.variant_repeats)
        return range(round(self.repeats * self.experiment.repeats))

    def choosing(self) -> range:
        """The seeds on which settings are chosen: half as many where half as many registrations are run."""
        return range(CHOSEN_FROM, CHOSEN_FROM + max(round(CHOOSING * min(self.experiment.repeats, 1.0)), 1))

    def known_cells(self) -> list[Known]:
        """The cells that the results hold, in the order of the experiment's run."""
        before = self.place("")
        names = [place.removeprefix(before).rpartition(" ") for place in self.results.kept if place.startswith(before)]
        found = [Known(panel, float(x)) for panel, _, x in names]
        panels = list(dict.fromkeys(cell.panel for cell in found))
        return sorted(found, key=lambda cell: (panels.index(cell.panel), cell.x))

    def chosen(self, method: Method) -> str:
        """The setting that failed least on the seeds for choosing, over all cells, then had least turn times shift."""
        cells = [cell.name for cell in self.known_cells()]

        def rank(setting: str) -> tuple[int, float]:
            found = [
                self.results.scores(self.place(cell), f"{method.name}; {setting}", self.choosing()) for cell in cells
            ]
            known = [x for x in found if x is not None]
            if not known:
                return 0, 0.0
            errors = np.array([(np.median(x.degrees), np.median(x.shifts)) for x in known])
            return sum(x.failed(self.experiment) for x in known), float(np.log(np.maximum(errors, SMALLEST)).mean())

        return min(method.settings, key=rank)

    def scores(self, method: Method, cell: str) -> Scores | None:
        """Of a method with its chosen setting in one cell, or None where it was not run."""
        name = f"{method.name}; {self.chosen(method)}"
        return self.results.scores(self.place(cell), name, self.seeds(method))

    def run(self, method: Method, cells: list[Cell]) -> None:
        """Choose the method's setting, then run the registrations that are missing."""
        taking = [cell for cell in cells if runs_in(method, self.experiment.name, *self._size(cell), self.sampling)]
        if len(method.settings) > 1:
            for setting in method.settings:
                for cell in taking:
                    self._fill(method, setting, cell, self.choosing())
        setting = self.chosen(method)
        for cell in taking:
            self._fill(method, setting, cell, self.seeds(method))

    def _size(self, cell: Cell) -> tuple[str, int]:
        return cell.panel, 500 if self.experiment.name == "fig2" else int(cell.x)

    def _fill(self, method: Method, setting: str, cell: Cell, seeds: range) -> None:
        place, name = self.place(cell.name), f"{method.name}; {setting}"
        missing = [seed for seed in seeds if str(seed) not in self.results.of(place, name)]
        if not missing:
            return
        trial = cell.make(0).first(method.most_points)
        if method.kind != "variant" and (method.name, len(trial.P)) not in self.results.warmed:
            method.settings[setting](trial)  # what is loaded and compiled once does not count
            self.results.warmed.add((method.name, len(trial.P)))
        for seed in missing:
            self.results.kept.setdefault(place, {}).setdefault(name, {})[str(seed)] = _one(method, setting, cell, seed)
        self.results.add(place, name, {})
        found = self.results.scores(place, name, missing)
        if found is not None:
            told = f"median {np.median(found.degrees):.3f} deg, {np.mean(found.seconds):.2f} s"
            print(f"{place}: {name}: {found.failed(self.experiment)}/{len(missing)} failed, {told}", flush=True)


def _one(method: Method, setting: str, cell: Cell, seed: int) -> list[float]:
    """Degrees, data units and processor seconds of one registration."""
    trial = cell.make(seed).first(method.most_points)
    before = time.process_time()
    found = method.settings[setting](trial)
    seconds = time.process_time() - before
    finite = bool(found.rotation.isfinite().all() and found.translation.isfinite().all())
    degrees, shift = trial.errors(found) if finite else (TURNED_ROUND, float("inf"))
    return [round(degrees, 6), round(shift, 8), round(seconds, 5)]
