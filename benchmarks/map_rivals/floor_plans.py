"""Simulated floor plans with their truth, as rows of the table of rivals: another building each time."""

import numpy as np

from benchmarks.mapping_rows import METRES, Row, simulated
from train.scans import ScanSet
from train.simulate import WorldSettings

PLANS = 20
KINDS = ("rooms", "loop", "corridor")
# As many as close their loop, and rays of one; people and trolleys of every second plan.
SCANS, BEAMS, MOVERS = 48, 180, 4


def settings(seed: int) -> WorldSettings:
    """Ranges with 1 cm of noise; the kinds in turn, movers in every second plan."""
    kind, movers = KINDS[seed % len(KINDS)], MOVERS * (seed % 2)
    return WorldSettings(kind=kind, scans=SCANS, beams=BEAMS, movers=movers, seed=seed)


def floor_plan(seed: int) -> ScanSet:
    """The scans in the frame of the first one."""
    return simulated(settings(seed))


def _name(seed: int) -> str:
    chosen = settings(seed)
    return f"plan {seed}, {chosen.kind}" + (f", {chosen.movers} movers" if chosen.movers else "")


# Nothing is wanted of these rows: no map of them has been promised.
FLOOR_PLANS = {_name(seed): Row(lambda seed=seed: floor_plan(seed), np.inf, METRES) for seed in range(PLANS)}
