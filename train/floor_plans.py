"""Random floor plans of office buildings, in metres: cells sharing walls, doors in those walls, and a tour.

A cell is an area up to the middle of its walls, so that neighbouring cells share a border and a door is a
piece of a border. The tour is the robot's coarse line; where it crosses a border there is a door.
"""

from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from shapely import Polygon, box
from shapely.affinity import affine_transform
from shapely.geometry.base import BaseGeometry

from train.doors import WALL, Doors, cut_doors
from train.world_settings import WorldSettings

# Ordinary office dimensions, metres.
ROOM_WIDTHS = (2.9, 4.6)
ROOM_DEPTHS = (3.4, 4.6)
CORRIDOR_WIDTHS = (1.9, 2.3)
HALLWAY_WIDTHS = (2.3, 2.8)
HALL_WIDTHS = (6.2, 7.0)
# Metres of path per scan that a building is planned for, and the shortest and longest path it is planned for.
PLANNED_STEP = 0.42
PLANNED_PATHS = (27.0, 120.0)
# A "rooms" tour this long, in metres, leaves the corridor for rooms on two sides of the building.
TWO_DETOURS = 40.0
# Metres that the rounding of its four corners takes off the way around a rectangle.
CORNER_CUTS = 3.0
# The core of a building, metres: stairs and a store room at the least.
SMALLEST_CORE = 2.6
SHARE_OF_NOTCHED_CORNERS = 0.35
# The hallway tour: distance of either lane from the middle, radius of the turn before rounding, way
# inside the first hall, and how far behind the middle of the last hall the turn has its own.
LANE = 0.32
TURN_RADIUS = 2.0
RUN_UP = 1.2
INTO_HALL = 0.4


@dataclass(frozen=True)
class FloorPlan:
    """A building seen from above.

    ``cells``: areas up to the middle of their walls, the corridor first. ``doors``: what is cut into walls.
    ``tour``: corners of the robot's way, to be rounded. ``closed``: whether the last one leads to the first.
    """

    cells: list[Polygon]
    doors: Doors
    tour: Float[np.ndarray, "n 2"]
    closed: bool

    @property
    def floors(self) -> list[Polygon]:
        """What is left of each cell between its walls."""
        return [cell.buffer(-WALL / 2, join_style="mitre") for cell in self.cells]

    @property
    def footprint(self) -> BaseGeometry:
        """The building with its outer walls."""
        return shapely.union_all(self.cells).buffer(WALL / 2, join_style="mitre")

    @property
    def free(self) -> BaseGeometry:
        """The floors and what is cut into the walls between them."""
        return shapely.union_all([*self.floors, *self.doors.openings, *self.doors.recesses])


def draw_floor_plan(settings: WorldSettings) -> FloorPlan:
    """A random plan of the kind and for the number of scans that ``settings`` ask for."""
    random = settings.random("plan")
    path = float(np.clip(PLANNED_STEP * settings.scans, *PLANNED_PATHS)) * random.uniform(0.97, 1.03)
    if settings.kind == "corridor":
        cells, tour = _hallway(path, random)
    else:
        cells, tour = _ring(path, random, detours=settings.kind == "rooms")
    cells, tour = _turned(cells, tour, random)
    closed = settings.kind != "corridor"
    doors = cut_doors(cells, np.vstack([tour, tour[:1]]) if closed else tour, random)
    return FloorPlan(cells, doors, tour, closed)


def _ring(path: float, random: np.random.Generator, *, detours: bool) -> tuple[list[Polygon], np.ndarray]:
    """A corridor around a core, rooms on all sides; the tour goes around, with ``detours`` through rooms."""
    width = random.uniform(*CORRIDOR_WIDTHS)
    north, south, east, west = random.uniform(*ROOM_DEPTHS, size=4)
    east_detour = (width + east) / 2 if detours else 0.0
    west_detour = (width + west) / 2 if detours and path > TWO_DETOURS else 0.0
    both = (path + CORNER_CUTS) / 2 - 2 * width - east_detour - west_detour
    depth = max(SMALLEST_CORE, both * random.uniform(0.38, 0.5))
    length = max(SMALLEST_CORE, both - depth)

    corridor = box(-width, -width, length + width, depth + width) - box(0, 0, length, depth)
    core = [box(x0, 0, x1, depth) for x0, x1 in _split(0, length, random)]
    left, right, top = -width, length + width, depth + width
    sides = [box(right, y0, right + east, y1) for y0, y1 in _split(-width, top, random)]
    sides += [box(left - west, y0, left, y1) for y0, y1 in _split(-width, top, random)]
    for y0, y1 in ((top, top + north), (-width - south, -width)):
        row = [box(x0, y0, x1, y1) for x0, x1 in _split(left - west, right + east, random)]
        notched = random.random(2) < SHARE_OF_NOTCHED_CORNERS
        sides += row[int(notched[0]) : len(row) - int(notched[1])]
    x0, x1 = -width / 2 - west_detour, length + width / 2 + east_detour
    y0, y1 = -width / 2, depth + width / 2
    return [corridor, *core, *sides], np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])


def _hallway(path: float, random: np.random.Generator) -> tuple[list[Polygon], np.ndarray]:
    """A hallway between two halls, rooms on both sides; the tour goes along it, around one hall and back."""
    width, hall = random.uniform(*HALLWAY_WIDTHS), random.uniform(*HALL_WIDTHS)
    turn = np.linspace(-0.83, 0.83, 13) * np.pi
    # Both ways, the turn in the hall and the lead into it; rounding shrinks the turn by about a quarter.
    length = (path - 0.75 * TURN_RADIUS * (turn[-1] - turn[0])) / 2 - RUN_UP - hall / 2 + TURN_RADIUS
    corridor = box(0, 0, length, width)
    middle = width / 2
    ends = [box(length, middle - hall / 2, length + hall, middle + hall / 2)]
    ends += [box(-hall, middle - hall / 2, 0, middle + hall / 2)]
    north, south = random.uniform(*ROOM_DEPTHS, size=2)
    rooms = [box(x0, width, x1, width + north) for x0, x1 in _split(0, length, random)]
    rooms += [box(x0, -south, x1, 0) for x0, x1 in _split(0, length, random)]
    around = [length + hall / 2 + INTO_HALL, middle] + TURN_RADIUS * np.column_stack([np.cos(turn), np.sin(turn)])
    lane = np.array([[-RUN_UP, middle - LANE], [length, middle - LANE]])
    tour = np.vstack([lane, around, lane[::-1] + [0, 2 * LANE]])
    return [corridor, *ends, *rooms], tour


def _split(start: float, stop: float, random: np.random.Generator) -> list[tuple[float, float]]:
    """A stretch of wall cut into rooms of about equal width."""
    count = max(1, int((stop - start) / random.uniform(*ROOM_WIDTHS)))
    shares = random.uniform(0.85, 1.15, size=count)
    cuts = start + (stop - start) * np.cumsum(shares) / shares.sum()
    # The last cut must be the end itself, bit for bit: neighbours find their border by equal coordinates.
    edges = [float(start), *cuts[:-1].tolist(), float(stop)]
    return list(zip(edges[:-1], edges[1:], strict=True))


def _turned(cells: list[Polygon], tour: np.ndarray, random: np.random.Generator) -> tuple[list[Polygon], np.ndarray]:
    """The plan mirrored and turned by quarter turns, walked in either direction."""
    axes = np.eye(2)[random.permutation(2)] * random.choice([-1.0, 1.0], size=2)
    cells = [affine_transform(cell, [*axes.ravel(), 0, 0]) for cell in cells]
    tour = tour @ axes.T
    return cells, tour[::-1] if random.random() < 0.5 else tour
