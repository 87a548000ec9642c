"""Occupancy grids from scans and poses: which cells the rays ended in and which they passed through."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

# Log-odds added by one hit and one pass, and the clamp: probabilities 0.7, 0.4, and 0.12 to 0.97.
# Source: A. Hornung et al., OctoMap, Autonomous Robots 34, 2013, section 5.1.
LOG_ODDS_HIT, LOG_ODDS_MISS = 0.85, -0.4
LOG_ODDS_RANGE = (-2.0, 3.5)
# Most cells along the longer side of a grid whose resolution is not given, and its cells per gap between neighbouring
# points of a scan: finer ones fall between the rays.
DEFAULT_CELLS = 2000
CELLS_PER_GAP = 2
# Scans, spread over the run, that tell the gap.
GAP_SCANS = 20
# Refused beyond this (9 bytes each).
MOST_CELLS = 100_000_000
# The area holds every point, except where single far returns would blow it up: along each axis it ends at
# most AREA_REACH times the span of these quantiles beyond them.
AREA_QUANTILES = (0.005, 0.995)
AREA_REACH = 0.5
# A border around that area, as a share of its longer side.
AREA_MARGIN = 0.02
# Half the height of the slab around the sensor that stands for 3D scans, as a share of their median range.
SLAB = 0.05
# What a scan saw of a cell; a hit outweighs passes.
PASSED, HIT = 1, 2
# Steps along rays held in memory at a time (40 bytes each).
STEPS_PER_CHUNK = 1_000_000


@dataclass(frozen=True)
class OccupancyGrid:
    """How often the cells of a horizontal grid were hit and passed by rays.

    ``hits``, ``misses``: ``(rows, columns)`` scans that saw the cell occupied, free; row 0 has the lowest y.
    ``origin``: ``(x, y)`` of the outer corner of cell (0, 0); ``resolution``: side of a cell; both in the
    data's unit.
    """

    hits: Int[np.ndarray, "rows columns"]
    misses: Int[np.ndarray, "rows columns"]
    origin: tuple[float, float]
    resolution: float

    @property
    def observed(self) -> Bool[np.ndarray, "rows columns"]:
        """Cells that some ray reached."""
        return (self.hits + self.misses) > 0

    @property
    def probability(self) -> Float[np.ndarray, "rows columns"]:
        """Probability that a cell is occupied, 0.5 where nothing was observed."""
        log_odds = np.clip(self.hits * LOG_ODDS_HIT + self.misses * LOG_ODDS_MISS, *LOG_ODDS_RANGE)
        return 1 / (1 + np.exp(-log_odds))

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """``(left, right, bottom, top)`` in the data's unit, for matplotlib's ``imshow(origin="lower")``."""
        (left, bottom), (rows, columns) = self.origin, self.hits.shape
        return left, left + columns * self.resolution, bottom, bottom + rows * self.resolution


def occupancy_grid(
    points: Sequence[Float[np.ndarray, "_ d"]],
    world_from_scan: Float[np.ndarray, "k m m"],
    *,
    resolution: float | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> OccupancyGrid:
    """Trace every ray from its sensor to its point: the last cell is hit, those before are passed.

    Each scan counts once per cell, a hit outweighing passes, so that walls seen at a grazing angle survive
    (as in W. Hess et al., Real-Time Loop Closure in 2D LIDAR SLAM, ICRA 2016). 3D scans (z up) are cut at a
    slab around the height of each sensor, thick a tenth of the median range: rays count while they are in it.

    Parameters
    ----------
    points: k scans ``(n_i, d)``, each in its own sensor frame (sensor at the origin).
    world_from_scan: ``(k, d + 1, d + 1)``.
    resolution: side of a cell in the data's unit; by default a round number (1, 2 or 5 times a power of ten)
        of at least half the gap between neighbouring points, and at most 2000 cells along the longer side.
    progress: called with (what, done, of).

    Raises
    ------
    ValueError: no points, numbers that do not match, or a resolution that is not positive or far too fine.
    """
    rays = _checked_rays(points, world_from_scan)
    grid = _empty_grid(rays, resolution)
    low, cell = np.array(grid.origin), grid.resolution
    high = low + cell * np.array(grid.hits.shape[::-1])
    half_height = max(SLAB * _median_range(rays), cell)
    seen = np.zeros(grid.hits.shape, dtype=np.uint8)
    for index, (sensor, ray) in enumerate(rays):
        inside = _share_inside(sensor, ray, low, high, half_height)
        _trace((sensor[:2] - low) / cell, ray[:, :2] * inside[:, None] / cell, inside == 1, seen)
        grid.hits[seen == HIT] += 1
        grid.misses[seen == PASSED] += 1
        seen[:] = 0
        if progress is not None:
            progress("occupancy", index + 1, len(rays))
    return grid


def _checked_rays(points: Sequence[np.ndarray], poses: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    if len(points) != len(poses) or not any(len(scan) for scan in points):
        raise ValueError(f"points: {len(points)} scans for {len(poses)} poses; give each pose its points")
    return [_world_rays(np.asarray(scan), pose) for scan, pose in zip(points, poses, strict=True)]


def _empty_grid(rays: list[tuple[np.ndarray, np.ndarray]], resolution: float | None) -> OccupancyGrid:
    if resolution is not None and not (np.isfinite(resolution) and resolution > 0):
        raise ValueError(f"resolution is {resolution}; give a positive length in the unit of the points")
    low, high = _area(rays)
    resolution = resolution or _round_resolution(max(np.max(high - low) / DEFAULT_CELLS, _gap(rays) / CELLS_PER_GAP))
    columns, rows = (int(n) for n in np.ceil((high - low) / resolution))
    if rows * columns > MOST_CELLS:
        raise ValueError(f"resolution is {resolution}: a grid of {rows} x {columns} cells; choose it coarser")
    hits, misses = np.zeros((2, rows, columns), dtype=np.int32)
    return OccupancyGrid(hits, misses, (float(low[0]), float(low[1])), resolution)


def _world_rays(scan: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The sensor's position ``(d,)`` and the rays ``(n, d)`` from it, along the world's axes."""
    d = scan.shape[1]
    return pose[:d, d], scan @ pose[:d, :d].T


def _median_range(rays: list[tuple[np.ndarray, np.ndarray]]) -> float:
    return float(np.median(np.concatenate([np.linalg.norm(ray, axis=1) for _, ray in rays])))


def _area(rays: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner ``(2,)`` of the area to draw; every sensor lies inside."""
    ends = np.concatenate([sensor[:2] + ray[:, :2] for sensor, ray in rays])
    sensors = np.stack([sensor[:2] for sensor, _ in rays])
    near_low, near_high = np.quantile(ends, AREA_QUANTILES, axis=0)
    reach = AREA_REACH * np.max(near_high - near_low)
    low = np.minimum(np.maximum(ends.min(axis=0), near_low - reach), sensors.min(axis=0))
    high = np.maximum(np.minimum(ends.max(axis=0), near_high + reach), sensors.max(axis=0))
    margin = AREA_MARGIN * float(np.max(high - low)) or 1.0
    return low - margin, high + margin


def _gap(rays: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Median distance, seen from above, of a point to the nearest other point of its scan."""
    scans = [ray[:, :2] for _, ray in rays[:: -(-len(rays) // GAP_SCANS)] if len(ray) > 1]
    gaps = [cKDTree(scan).query(scan, k=2)[0][:, 1] for scan in scans]
    return float(np.median(np.concatenate(gaps))) if gaps else 0.0


def _round_resolution(length: float) -> float:
    """The smallest 1, 2 or 5 times a power of ten that is not below ``length``."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= length * (1 - 1e-9)))


def _share_inside(
    sensor: np.ndarray, ray: np.ndarray, low: np.ndarray, high: np.ndarray, half_height: float
) -> np.ndarray:
    """The share ``(n,)`` of each ray, from its sensor on, that stays in the area and (3D) the slab."""
    room = np.where(ray[:, :2] > 0, high - sensor[:2], sensor[:2] - low)
    if ray.shape[1] == 3:
        room = np.concatenate((room, np.full((len(ray), 1), half_height)), axis=1)
    length = np.abs(ray)
    return np.min(room / np.maximum(length, room), axis=1)


def _trace(start: np.ndarray, rays: np.ndarray, whole: np.ndarray, seen: np.ndarray) -> None:
    """Mark in ``seen`` ``(rows, columns)`` the cells that rays ``(n, 2)`` from ``start`` pass and, if
    whole, hit.

    One step per cell along the longer axis of each ray (J. Bresenham, 1965); all lengths are in cells.
    """
    last = np.array(seen.shape)[::-1] - 1
    ends = np.minimum((start + rays).astype(np.int64), last)
    steps = np.ceil(np.abs(rays).max(axis=1)).astype(np.int64)
    for chunk in _chunks(steps):
        count = steps[chunk]
        step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        at = start + np.repeat(rays[chunk] / np.maximum(count, 1)[:, None], count, axis=0) * step[:, None]
        column, row = np.minimum(at.astype(np.int64), last).T
        seen[row, column] = PASSED
    seen[ends[:, 1], ends[:, 0]] = PASSED
    seen[ends[whole, 1], ends[whole, 0]] = HIT


def _chunks(steps: np.ndarray) -> Iterator[slice]:
    """Consecutive slices of the rays, each of about STEPS_PER_CHUNK steps."""
    borders = np.flatnonzero(np.diff(np.cumsum(steps) // STEPS_PER_CHUNK)) + 1
    edges = [0, *borders.tolist(), len(steps)]
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        yield slice(begin, end)
