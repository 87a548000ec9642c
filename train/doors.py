"""Doors of a floor plan, in metres: where the tour crosses a wall, and one for every other room."""

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
import shapely
from shapely import LineString, Polygon
from shapely.ops import substring

# Building practice, metres: partition walls, single doors, and the wider ones on the robot's tour.
WALL = 0.15
DOOR = 0.95
TOUR_DOOR = 1.3
LEAF_THICKNESS = 0.04
# A piece of wall shorter than this gets no door: the door and a frame on both sides.
SHORTEST_WALL = DOOR + 0.4
SHARE_OF_OPEN_DOORS = 0.75
# How far a leaf stands open, radians.
LEAF_ANGLES = (0.9, 1.9)
# Openings reach this far beyond the wall, so that unions with the floors leave no slivers. Metres.
OVERLAP = 0.01


@dataclass(frozen=True)
class Doors:
    """``openings`` through walls, open ``leaves`` standing beside them, ``recesses`` where a door is shut."""

    openings: list[Polygon] = field(default_factory=list)
    leaves: list[Polygon] = field(default_factory=list)
    recesses: list[Polygon] = field(default_factory=list)


def cut_doors(cells: list[Polygon], tour: np.ndarray, random: np.random.Generator) -> Doors:
    """Doors where ``tour`` ``(n, 2)`` crosses borders of ``cells``, and one for every other cell.

    Cell 0 is the corridor: rooms open onto it where they touch it, onto a neighbour where they do not.
    """
    doors = Doors()
    way = LineString(tour)
    borders = {pair: _border(cells[pair[0]], cells[pair[1]]) for pair in combinations(range(len(cells)), 2)}
    reached = {0}
    for pair, pieces in borders.items():
        for piece in pieces:
            if piece.intersects(way):
                _open_tour_door(doors, piece, way)
                reached.update(pair)
    for room in range(1, len(cells)):
        choices = [(other, piece) for other, piece in _borders_of(room, borders) if piece.length > SHORTEST_WALL]
        onto_corridor = [choice for choice in choices if choice[0] == 0]
        if room in reached or not choices:
            continue
        _, piece = max(onto_corridor or choices, key=lambda choice: choice[1].length)
        _place_door(doors, piece, cells[room], random, shut=random.random() > SHARE_OF_OPEN_DOORS)
    return doors


def _border(one: Polygon, other: Polygon) -> list[LineString]:
    """The straight pieces of wall between two cells."""
    shared = shapely.line_merge(one.boundary.intersection(other.boundary))
    lines = [part for part in shapely.get_parts(shared) if isinstance(part, LineString)]
    corners = [np.asarray(line.simplify(0).coords) for line in lines]
    return [LineString(ends) for line in corners for ends in zip(line[:-1], line[1:], strict=True)]


def _borders_of(room: int, borders: dict[tuple[int, int], list[LineString]]) -> list[tuple[int, LineString]]:
    """(neighbour, piece of wall) for every piece of wall of ``room``."""
    return [(sum(pair) - room, piece) for pair, pieces in borders.items() if room in pair for piece in pieces]


def _open_tour_door(doors: Doors, wall: LineString, way: LineString) -> None:
    """An opening, without a leaf, wide enough for every place where the tour crosses ``wall``."""
    crossings = shapely.get_coordinates(wall.intersection(way))
    spread = float(np.linalg.norm(crossings.max(axis=0) - crossings.min(axis=0)))
    reach = (min(TOUR_DOOR + spread, wall.length - WALL)) / 2
    middle = wall.project(shapely.Point(crossings.mean(axis=0)))
    middle = float(np.clip(middle, reach, wall.length - reach))
    doors.openings.append(_through(substring(wall, middle - reach, middle + reach)))


def _place_door(doors: Doors, wall: LineString, room: Polygon, random: np.random.Generator, *, shut: bool) -> None:
    """A door somewhere in ``wall``: an opening with its leaf in the room, or the recess of a shut door."""
    margin = (SHORTEST_WALL - DOOR) / 2
    start = random.uniform(margin, wall.length - margin - DOOR)
    opening = substring(wall, start, start + DOOR)
    inwards = _inwards(opening, room)
    if shut:
        doors.recesses.append(opening.buffer(-inwards * (WALL / 2 + OVERLAP), single_sided=True))
        return
    doors.openings.append(_through(opening))
    ends = np.asarray(opening.coords)
    if random.random() < 0.5:
        ends, inwards = ends[::-1], -inwards
    angle = inwards * random.uniform(*LEAF_ANGLES)
    along = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) @ (ends[1] - ends[0])
    normal = inwards * np.array([ends[0, 1] - ends[1, 1], ends[1, 0] - ends[0, 0]]) / DOOR
    hinge = ends[0] + normal * (WALL / 2)
    doors.leaves.append(LineString([hinge, hinge + along]).buffer(LEAF_THICKNESS / 2, cap_style="flat"))


def _inwards(opening: LineString, room: Polygon) -> int:
    """+1 where ``room`` lies to the left of ``opening``, -1 to the right."""
    return 1 if room.contains(opening.buffer(WALL, single_sided=True).centroid) else -1


def _through(opening: LineString) -> Polygon:
    """The piece of wall around ``opening``, a little thicker than the wall."""
    return opening.buffer(WALL / 2 + OVERLAP, cap_style="flat")
