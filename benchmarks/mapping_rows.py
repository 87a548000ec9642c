"""The real sequences of the table of maps, as they are and made harder: gaps, noise, movers, a narrow view.

Movers: six discs around the sensor, placed by the true poses. Every second one goes along with the sensor, now before
it, now beside it; the others cross its way in straight lines and begin anew when they are out of reach. A ray ends at
the first disc it meets before its wall. One factor on all radii is chosen so that the discs hide the wanted share of
all rays of the sequence.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.data import data_folder
from train.console import PrintedUnit
from train.scans import ScanSet, planar_poses
from train.simulate import WorldSettings, simulate

# Side of v1_pose0's picture: its unit is 512 px.
SIDE = 512.0
PEOPLE = 6
# Pixels: how near and how far companions stay, how far passers-by are seen; radii before the common factor.
NEAR, FAR, REACH = 25.0, 60.0, 90.0
RADII = (5.0, 10.0)
# Turn of a companion about the sensor, radians a scan, and the speed of a passer-by, pixels a scan.
SWING, SPEED = 0.08, (4.0, 12.0)
V1 = "seq_deepmapping2d_v1_pose0"
PIXELS, METRES = PrintedUnit(SIDE, "px"), PrintedUnit(1.0, "m")


class Row(NamedTuple):
    """One row: how its scans are made, the largest error wanted, and which error that is."""

    make: Callable[[], ScanSet]
    wanted: float
    unit: PrintedUnit
    error: str = "ape_rmse"


def sequence(file: str, stride: int = 1) -> ScanSet:
    """Every ``stride``-th scan of a file; planar where all z are 0."""
    with np.load(data_folder() / f"{file}.npz", allow_pickle=False) as held:
        points, bounds, poses = held["points"].astype(float), held["offsets"], held["poses"].astype(float)
    flat = not points[:, 2].any()
    chosen = np.arange(0, len(poses), stride)
    scans = [points[bounds[i] : bounds[i + 1], : 2 if flat else 3] for i in chosen]
    truth = np.linalg.inv(poses[0]) @ poses[chosen]
    truth = truth[:, [0, 1, 3]][:, :, [0, 1, 3]] if flat else truth
    return ScanSet(scans, [str(i) for i in chosen], chosen.astype(float), truth=truth)


def simulated(settings: WorldSettings) -> ScanSet:
    """Scans of a planar world in the frame of the first one, with their truth."""
    world = simulate(settings)
    truth = planar_poses(np.linalg.inv(world.world_from_scan[0]) @ world.world_from_scan, "truth")
    return ScanSet(world.points, [str(i) for i in range(len(truth))], world.timestamps, truth=truth)


def noisy(scans: ScanSet, deviation: float, seed: int = 0) -> ScanSet:
    """Every range longer or shorter by normal noise of this ``deviation``."""
    random = np.random.default_rng(seed)
    ranges = [np.linalg.norm(scan, axis=1, keepdims=True) for scan in scans.points]
    moved = [
        scan * (1 + deviation * random.normal(size=far.shape) / far)
        for scan, far in zip(scans.points, ranges, strict=True)
    ]
    return ScanSet(moved, scans.names, scans.timestamps, truth=scans.truth)


def narrowed(scans: ScanSet, degrees: float) -> ScanSet:
    """The rays within half of ``degrees`` to both sides of straight ahead."""
    half = np.deg2rad(degrees) / 2
    kept = [scan[np.abs(np.arctan2(scan[:, 1], scan[:, 0])) <= half] for scan in scans.points]
    return ScanSet(kept, scans.names, scans.timestamps, truth=scans.truth)


def crowded(scans: ScanSet, share: float, seed: int) -> ScanSet:
    """Planar scans with people in the way of ``share`` of all rays; lengths in units of ``SIDE`` pixels."""
    random = np.random.default_rng(seed)
    places = _people(scans.truth, random)
    radii = random.uniform(*RADII, size=PEOPLE) / SIDE
    low, high = 0.0, 10.0
    for _ in range(20):  # bisection: the factor to a hundred-thousandth
        factor = (low + high) / 2
        hidden = [_hidden(scan, place, factor * radii) for scan, place in zip(scans.points, places, strict=True)]
        covered = np.mean(np.concatenate([reach < 1 for reach in hidden]))
        low, high = (factor, high) if covered < share else (low, factor)
    points = [scan * np.minimum(reach, 1)[:, None] for scan, reach in zip(scans.points, hidden, strict=True)]
    return ScanSet(points, scans.names, scans.timestamps, truth=scans.truth)


def _people(truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Where everybody is as each scan sees it, ``(k, PEOPLE, 2)``."""
    k = len(truth)
    around = np.empty((k, PEOPLE, 2))
    for person in range(0, PEOPLE, 2):
        angle = random.uniform(0, 2 * np.pi) + np.cumsum(SWING * random.normal(size=k))
        wave = np.sin(random.uniform(0, 2 * np.pi) + np.arange(k) * random.uniform(0.05, 0.2))
        distance = (NEAR + FAR) / 2 + (FAR - NEAR) / 2 * wave
        around[:, person] = distance[:, None] * np.stack((np.cos(angle), np.sin(angle)), 1)
    sensor = truth[:, :2, 2] * SIDE
    for person in range(1, PEOPLE, 2):
        place = np.full(2, np.inf)
        for scan in range(k):
            if not np.linalg.norm(place - sensor[scan]) < REACH:
                begin, heading = random.uniform(0, 2 * np.pi, size=2)
                place = sensor[scan] + random.uniform(NEAR, REACH) * np.array([np.cos(begin), np.sin(begin)])
                step = random.uniform(*SPEED) * np.array([np.cos(heading), np.sin(heading)])
            around[scan, person] = place - sensor[scan]
            place = place + step
    return np.einsum("kba,kpb->kpa", truth[:, :2, :2], around) / SIDE


def _hidden(scan: np.ndarray, places: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """The share of each ray, ``(n,)``, at which it meets the first disc; infinite where it meets none."""
    far = np.linalg.norm(scan, axis=1)
    directions = scan / far[:, None]
    along = directions @ places.T
    room = along**2 - (places**2).sum(1) + radii**2
    inside = (places**2).sum(1) <= radii**2  # nobody stands on the sensor
    met = np.where((room > 0) & (along > 0) & ~inside, along - np.sqrt(np.maximum(room, 0)), np.inf)
    return met.min(axis=1) / far


def _v1(stride: int = 2) -> ScanSet:
    return sequence(V1, stride)


def _rows() -> dict[str, Row]:
    pixel = 1 / SIDE
    rows = {f"v1_pose0, stride {s}": Row(lambda s=s: _v1(s), 0.01, PIXELS) for s in (4, 2, 1)}
    rows["v1_pose0, noise 1 px"] = Row(lambda: noisy(_v1(), pixel), 0.25, PIXELS)
    rows["v1_pose0, 180 deg"] = Row(lambda: narrowed(_v1(), 180.0), 1.0, PIXELS)
    for share, wanted in ((20, 10.0), (40, 50.0)):
        for seed in range(5):
            make = lambda share=share, seed=seed: crowded(_v1(), share / 100, seed)  # noqa: E731
            rows[f"v1_pose0, movers {share} %, seed {seed}"] = Row(make, wanted, PIXELS)
    for name, file, wanted in (
        ("balm 30-108", "seq_balm_realworld_30-108", {1: 0.05, 2: 0.1}),
        ("kitti00 0-15", "seq_kitti00_0-15", {1: 0.015, 2: 0.015, 4: 0.015}),
        ("kitti07 submaps", "seq_kitti07_submaps_gtsam", {1: 0.01}),
        ("iclnuim", "seq_iclnuim_livingroom_0-120", {1: 0.009}),
        ("tum", "seq_tum_fr1_desk_5", {1: 0.0013}),
    ):
        for s, most in wanted.items():
            rows[f"{name}, stride {s}"] = Row(lambda file=file, s=s: sequence(file, s), most, METRES)
    for name, file, wanted in (
        ("3dmatch kitchen", "seq_3dmatch_kitchen_0_1_4_5", 0.05),
        ("bunny scans", "seq_stanford_bunny", 0.003),
        ("dragon scans", "seq_stanford_dragon", 0.0007),
    ):
        rows[name] = Row(lambda file=file: sequence(file), wanted, METRES, "point_rms_displacement")
    return rows


ROWS = _rows()
