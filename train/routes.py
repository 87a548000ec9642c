"""The robot's way through a floor plan: corners rounded, speed and turning limited, one pose per scan."""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from shapely import LinearRing, LineString

from train.floor_plans import FloorPlan
from train.world_settings import WorldSettings

# Metres between the points that the way is drawn with.
FINE_STEP = 0.05
# Widths, in metres, of the Gaussians that round the corners (to a radius of 0.9 of it) and draw the wander.
ROUNDING = 1.5
WANDER_WIDTH = 1.5
# How far the robot strays from the middle of its way, root mean square metres per axis.
WANDER = 0.05
# Cruising speed and turning limit of a delivery robot, per scan: 0.5 m and 13 degrees; two scans a second.
CRUISE = 0.5
TURN = np.deg2rad(13.0)
SCAN_PERIOD_S = 0.5
# Width in metres of the Gaussian that softens braking and accelerating.
BRAKING = 0.4
# A closed way is driven this many times at least, so that its beginning is seen again, at a pace between
# these multiples of cruising speed (slower: more laps instead, faster: the drive ends before the loop is closed).
LAPS = 1.1
PACES = (0.8, 1.5)
# Metres above the floor of a lidar on a mast. It sways while driving: amplitudes of roll and pitch in radians
# and of height in metres, about twice the root mean square.
SENSOR_HEIGHT_3D = 1.0
SWAY = np.deg2rad(1.0)
HEAVE = 0.01


@dataclass(frozen=True)
class Route:
    """A drawn way: ``positions (n, 2)``, metres, and ``headings (n,)``, unwrapped radians, at ``times``.

    Times count scans at cruising pace. A closed route ends where it began, its last heading a full turn on.
    """

    positions: Float[np.ndarray, "n 2"]
    headings: Float[np.ndarray, "n"]
    times: Float[np.ndarray, "n"]
    closed: bool

    def at(self, times: Float[np.ndarray, "k"]) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
        """Positions ``(k, 2)`` and headings ``(k,)`` at any times.

        A closed route goes round and round, an open one goes straight on beyond its ends at cruising speed.
        """
        inside = np.mod(times, self.times[-1]) if self.closed else np.clip(times, 0, self.times[-1])
        x, y, headings = (np.interp(inside, self.times, column) for column in (*self.positions.T, self.headings))
        beyond = np.zeros_like(times) if self.closed else CRUISE * (times - inside)
        return np.column_stack([x + beyond * np.cos(headings), y + beyond * np.sin(headings)]), headings

    def line(self, beyond: float) -> LineString:
        """The whole way; an open one with ``beyond`` scans at cruising pace before and after it."""
        ends, _ = self.at(np.array([-beyond, self.times[-1] + beyond]))
        return LineString(self.positions if self.closed else [ends[0], *self.positions, ends[1]])


def draw_route(plan: FloorPlan, random: np.random.Generator) -> Route:
    """The plan's tour with its corners rounded and a little wander, driven no faster than the robot can."""
    mode = "wrap" if plan.closed else "nearest"
    way = _evenly(plan.tour, closed=plan.closed)
    strays = gaussian_filter1d(random.normal(size=way.shape), WANDER_WIDTH / FINE_STEP, axis=0, mode=mode)
    way = gaussian_filter1d(way, ROUNDING / FINE_STEP, axis=0, mode=mode) + WANDER * strays / strays.std()
    if plan.closed:
        way = np.vstack([way, way[:1]])
        tangents = np.gradient(np.vstack([way[-2], way, way[1]]), axis=0)[1:-1]
    else:
        tangents = np.gradient(way, axis=0)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    headings = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    limits = np.stack([np.full(len(arc), 1 / CRUISE), np.abs(np.gradient(headings, arc)) / TURN])
    # Scans per metre: a smooth maximum of the two limits, driving straight and turning.
    slowness = gaussian_filter1d(np.linalg.norm(limits, ord=4, axis=0), BRAKING / FINE_STEP, mode=mode)
    return Route(way, headings, cumulative_trapezoid(slowness, arc, initial=0.0), plan.closed)


def drive(
    route: Route, settings: WorldSettings, random: np.random.Generator
) -> tuple[Float[np.ndarray, "k 4 4"], Float[np.ndarray, "k"]]:
    """``world_from_scan`` ``(k, 4, 4)`` of every scan and its time in ``route``'s unit ``(k,)``.

    The pace is chosen so that the scans close the loop and see its beginning again; an open route is driven
    to its end. In 3D the sensor stands ``SENSOR_HEIGHT_3D`` above the floor at z = 0 and sways; in 2D z = 0.
    """
    whole = float(route.times[-1])
    if route.closed:
        pace, start = float(np.clip(LAPS * whole / settings.scans, *PACES)), random.uniform(0, whole)
    else:
        pace, start = min(whole / (settings.scans - 1), PACES[1]), 0.0
    times = start + pace * np.arange(settings.scans)
    positions, headings = route.at(times)
    sway = np.zeros((settings.scans, 3))
    if settings.dimension == 3:
        sway = gaussian_filter1d(random.normal(size=sway.shape), 1.0, axis=0) * [SWAY, SWAY, HEAVE]
        sway[:, 2] += SENSOR_HEIGHT_3D
    world_from_scan = np.tile(np.eye(4), (settings.scans, 1, 1))
    world_from_scan[:, :3, :3] = Rotation.from_euler("ZYX", np.column_stack([headings, sway[:, :2]])).as_matrix()
    world_from_scan[:, :3, 3] = np.column_stack([positions, sway[:, 2]])
    return world_from_scan, times


def _evenly(corners: Float[np.ndarray, "n 2"], *, closed: bool) -> Float[np.ndarray, "m 2"]:
    """Points about ``FINE_STEP`` apart along ``corners``; a closed line does not repeat its first."""
    line = LinearRing(corners) if closed else LineString(corners)
    count = round(line.length / FINE_STEP) + 1
    points = line.interpolate(np.linspace(0.0, 1.0, count, endpoint=not closed), normalized=True)
    return shapely.get_coordinates(points)
