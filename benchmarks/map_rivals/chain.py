"""What the rivals share: scans in units of their reach, a chain of registered pairs, turned starts, loop candidates."""

from collections.abc import Iterator
from typing import Protocol

import numpy as np
from scipy.spatial import KDTree

from train.chain import POOR, YAW_STARTS
from train.scans import Progress, ScanSet

# Scans of a window, and how far apart in time, in reaches and how many per scan loop candidates are.
WINDOW, APART, NEAR, LOOPS_PER_SCAN = 3, 9, 0.5, 3
# Points of a scan whose overlap is looked at.
LOOKED_AT = 2000
# A rival's variants: as it is made, with turned starts where the overlap is poor, with matched features, with a graph.
PLAIN, YAW, FEATURES = "plain", "yaw starts", "feature starts"
GRAPH, GRAPH_YAW = "graph", "graph, yaw starts"
Solutions = Iterator[tuple[str, np.ndarray]]


class PairRival(Protocol):
    """Registers pairs of scans: ``register(target, source, start)`` answers ``target_from_source (m, m)``."""

    points: list[np.ndarray]
    tolerance: float

    def register(self, target: int, source: int, start: np.ndarray) -> np.ndarray:
        """The motion found from ``start``."""


def reach(scans: ScanSet) -> float:
    """Median over the scans of the median distance of their points from their middle."""
    return float(np.median([np.median(np.linalg.norm(x - x.mean(axis=0), axis=1)) for x in scans.points]))


def in_reaches(scans: ScanSet) -> list[np.ndarray]:
    """The scans' points ``(n, d)``, lengths in reaches."""
    unit = reach(scans)
    return [np.ascontiguousarray(points / unit) for points in scans.points]


def in_own_unit(poses: np.ndarray, unit: float) -> np.ndarray:
    """Poses ``(k, m, m)`` in reaches, their positions in the scans' own unit."""
    scaled = poses.copy()
    scaled[:, :-1, -1] *= unit
    return scaled


def in_space(points: np.ndarray) -> np.ndarray:
    """Points ``(n, 3)``; those of the plane at z = 0."""
    return points if points.shape[1] == 3 else np.pad(points, ((0, 0), (0, 1)))


def turned(yaw: float, size: int) -> np.ndarray:
    """A turn about the vertical axis, radians, ``(size, size)``."""
    motion = np.eye(size)
    motion[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    return motion


class Overlap:
    """The share of points, both ways, that lie within ``tolerance`` of the other scan."""

    def __init__(self, clouds: list[np.ndarray], tolerance: float) -> None:
        self.clouds = [cloud[:: max(1, len(cloud) // LOOKED_AT)] for cloud in clouds]
        self.trees = [KDTree(cloud) for cloud in clouds]
        self.tolerance = tolerance

    def __call__(self, target: int, source: int, motion: np.ndarray) -> float:
        """Share in [0, 1] under ``target_from_source``."""
        d = self.clouds[0].shape[1]
        back = np.linalg.inv(motion)
        ways = ((target, source, motion[:d, :d], motion[:d, -1]), (source, target, back[:d, :d], back[:d, -1]))
        shares = []
        for there, here, rotation, shift in ways:
            moved = self.clouds[here] @ rotation.T + shift
            found = self.trees[there].query(moved, distance_upper_bound=self.tolerance)[0]
            shares.append(np.isfinite(found).mean())
        return float(np.mean(shares))


def chained(rival: PairRival, size: int, follow: bool, told: Progress) -> np.ndarray:
    """Motions ``(k - 1, size, size)`` of each scan to the one before; ``follow``: begin at the last, else in place."""
    motions: list[np.ndarray] = []
    count = len(rival.points) - 1
    for pair in range(count):
        start = motions[-1] if follow and motions else np.eye(size)
        motions.append(rival.register(pair, pair + 1, start))
        told("chain", pair + 1, count)
    return np.stack(motions)


def from_turned_starts(rival: PairRival, motions: np.ndarray, told: Progress) -> np.ndarray:
    """The motions, those of a poor overlap sought again from the turned starts of our own chain; the overlap decides.

    Poor is what is below our chain's part of the best tenth, not of the median: in short sequences half may be poor.
    """
    overlap, size = Overlap(rival.points, rival.tolerance), motions.shape[-1]
    fits = [overlap(pair, pair + 1, motion) for pair, motion in enumerate(motions)]
    poor = [pair for pair, fit in enumerate(fits) if fit < POOR * np.quantile(fits, 0.9)]
    found = motions.copy()
    for done, pair in enumerate(poor):
        told("turned starts", done, len(poor))
        tried = [rival.register(pair, pair + 1, turned(yaw, size)) for yaw in YAW_STARTS]
        found[pair] = best_overlap(overlap, pair, [motions[pair], *tried])
    return found


def best_overlap(overlap: Overlap, pair: int, motions: list[np.ndarray]) -> np.ndarray:
    """The motion of scan ``pair + 1`` to ``pair`` under which they overlap most; the first of equals."""
    return max(motions, key=lambda motion: overlap(pair, pair + 1, motion))


def along(motions: np.ndarray) -> np.ndarray:
    """Poses ``(k, m, m)`` of chained motions, the first at the origin."""
    poses = [np.eye(motions.shape[-1])]
    for motion in motions:
        poses.append(poses[-1] @ motion)
    return np.stack(poses)


def window_pairs(scans: int) -> list[tuple[int, int]]:
    """Pairs two to ``WINDOW`` scans apart."""
    return [(i, i + step) for step in range(2, WINDOW + 1) for i in range(scans - step)]


def loop_pairs(poses: np.ndarray) -> list[tuple[int, int]]:
    """Pairs that the poses (in reaches) put close together though far apart in time, the nearest of each scan."""
    places, pairs = poses[:, :-1, -1], []
    for i, place in enumerate(places):
        far = np.linalg.norm(places - place, axis=1)
        later = [j for j in np.argsort(far) if j >= i + APART and far[j] <= NEAR]
        pairs += [(i, int(j)) for j in later[:: max(1, len(later) // LOOPS_PER_SCAN)][:LOOPS_PER_SCAN]]
    return pairs
