"""Simulated floor plans with their truth, as rows of the table of rivals: another building each time."""

import numpy as np

from benchmarks.mapping_rows import METRES, Row
from train.scans import ScanSet, planar_poses
from train.simulate import WorldSettings, simulate

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
    world = simulate(settings(seed))
    truth = planar_poses(np.linalg.inv(world.world_from_scan[0]) @ world.world_from_scan, "truth")
    return ScanSet(world.points, [str(i) for i in range(len(truth))], world.timestamps, truth=truth)


def _name(seed: int) -> str:
    chosen = settings(seed)
    return f"plan {seed}, {chosen.kind}" + (f", {chosen.movers} movers" if chosen.movers else "")


# Nothing is wanted of these rows: no map of them has been promised.
FLOOR_PLANS = {_name(seed): Row(lambda seed=seed: floor_plan(seed), np.inf, METRES) for seed in range(PLANS)}
