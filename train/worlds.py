"""A floor plan made solid: walls, door leaves and furniture as one triangle mesh, in metres."""

from dataclasses import dataclass
from typing import cast

import numpy as np
import shapely
import trimesh
from shapely import LineString, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from train.floor_plans import FloorPlan
from train.world_settings import WorldSettings

# Heights above the floor, metres.
STOREY = 2.6
DOOR_HEIGHT = 2.05
SLAB = 0.1
# Half the width that is kept free along the robot's way, and the space kept free in front of doors. Metres.
KEPT_FREE = 0.5
DOOR_SPACE = 0.35
# Least gap between two pieces of furniture, and between a piece and the wall it stands at. Metres.
GAP = 0.05
OFF_WALL = 0.01
# How far free-standing furniture is turned away from the walls' directions, root mean square radians.
UNTIDY = 0.2
# Attempts at placing one piece before the room is left as it is.
ATTEMPTS = 20
# Square metres of floor for one piece of furniture: rooms are full, corridors are kept clear.
ROOM_PER_PIECE = 1.4
CORRIDOR_PER_PIECE = 4.0


@dataclass(frozen=True)
class Piece:
    """A kind of furniture: ranges of ``width``, ``depth`` and ``height`` in metres, and where it stands."""

    width: tuple[float, float]
    depth: tuple[float, float]
    height: tuple[float, float]
    at_wall: bool = False
    round: bool = False


# Catalogue dimensions of office furniture; round pieces use ``width`` as their diameter.
CABINET = Piece((0.8, 1.6), (0.35, 0.5), (1.2, 2.0), at_wall=True)
DESK = Piece((1.2, 1.8), (0.7, 0.8), (0.72, 0.76), at_wall=True)
SOFA = Piece((1.4, 2.0), (0.75, 0.9), (0.7, 0.9), at_wall=True)
TABLE = Piece((1.0, 1.8), (0.7, 1.0), (0.72, 0.76))
ROUND_TABLE = Piece((0.7, 1.1), (0.0, 0.0), (0.72, 0.76), round=True)
CHAIR = Piece((0.42, 0.5), (0.42, 0.5), (0.8, 1.0))
COLUMN = Piece((0.3, 0.5), (0.0, 0.0), (STOREY, STOREY), round=True)
LOCKER = Piece((0.4, 1.2), (0.25, 0.35), (1.5, 1.9), at_wall=True)
PLANT = Piece((0.3, 0.4), (0.0, 0.0), (0.6, 1.4), round=True)
ROOM_PIECES = (CABINET, CABINET, DESK, DESK, SOFA, TABLE, ROUND_TABLE, CHAIR, CHAIR, COLUMN, PLANT)
CORRIDOR_PIECES = (LOCKER, LOCKER, PLANT)


@dataclass(frozen=True)
class World:
    """``mesh``: all that stands still, the floor's surface at z = 0. ``open_floor``: where nothing stands."""

    mesh: trimesh.Trimesh
    open_floor: BaseGeometry


def build_world(plan: FloorPlan, way: LineString, settings: WorldSettings) -> World:
    """``plan`` made solid and furnished so that the robot's ``way`` stays clear."""
    doors = shapely.union_all([*plan.doors.openings, *plan.doors.recesses])
    kept_free = way.buffer(KEPT_FREE) | doors.buffer(DOOR_SPACE)
    leaves = [leaf for leaf in plan.doors.leaves if not leaf.intersects(way.buffer(KEPT_FREE))]
    furniture = furnish(plan, shapely.union_all([kept_free, *leaves]), settings.random("furniture"))

    openings = [*plan.doors.openings, *plan.doors.recesses]
    solids = _prisms(plan.footprint - plan.free, 0, STOREY)
    solids += [prism for opening in openings for prism in _prisms(opening, DOOR_HEIGHT, STOREY)]
    solids += [prism for leaf in leaves for prism in _prisms(leaf, 0, DOOR_HEIGHT)]
    solids += [prism for shape, height in furniture for prism in _prisms(shape, 0, height)]
    solids += _prisms(plan.footprint, -SLAB, 0)
    if settings.ceiling:
        solids += _prisms(plan.footprint, STOREY, STOREY + SLAB)
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(solids))
    standing = shapely.union_all([*leaves, *(shape for shape, _ in furniture)])
    return World(mesh, plan.free - standing)


def furnish(plan: FloorPlan, kept_free: BaseGeometry, random: np.random.Generator) -> list[tuple[Polygon, float]]:
    """Footprint and height of every piece of furniture, clear of each other and of ``kept_free``."""
    placed: list[tuple[Polygon, float]] = []
    for index, floor in enumerate(plan.floors):
        pieces, area = (CORRIDOR_PIECES, CORRIDOR_PER_PIECE) if index == 0 else (ROOM_PIECES, ROOM_PER_PIECE)
        vacant = floor - kept_free
        for _ in range(int(floor.area / area)):
            piece = pieces[random.integers(len(pieces))]
            shape = _placed(piece, floor, vacant, random)
            if shape is not None:
                placed.append((shape, float(random.uniform(*piece.height))))
                vacant = vacant - shape.buffer(GAP)
    return placed


def _placed(piece: Piece, floor: Polygon, vacant: BaseGeometry, random: np.random.Generator) -> Polygon | None:
    """One piece somewhere in ``vacant``, a part of ``floor``, or None where no attempt found room for it."""
    width, depth = random.uniform(*piece.width), random.uniform(*piece.depth)
    shape = Point(0, 0).buffer(width / 2) if piece.round else box(0, 0, width, depth)
    stands = _against_walls if piece.at_wall else _standing_free
    corners, angles = stands(floor, random)
    cosines, sines = np.cos(angles), np.sin(angles)
    turns = np.stack([np.stack([cosines, -sines], axis=-1), np.stack([sines, cosines], axis=-1)], axis=-2)
    outline = shapely.get_coordinates(shape)
    attempts = shapely.polygons(outline @ turns.swapaxes(1, 2) + corners[:, None])
    shapely.prepare(vacant)
    return next(iter(attempts[shapely.covers(vacant, attempts)]), None)


def _against_walls(floor: Polygon, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Where a lower left corner may stand at the floor's walls ``(attempts, 2)``, and the walls' directions."""
    # Once its rings are oriented, a polygon lies to the left of every edge, holes included.
    rings = shapely.orient_polygons(floor)
    lines = [np.asarray(ring.coords) for ring in (rings.exterior, *rings.interiors)]
    starts, stops = np.vstack([line[:-1] for line in lines]), np.vstack([line[1:] for line in lines])
    chosen = random.integers(len(starts), size=ATTEMPTS)
    along = stops[chosen] - starts[chosen]
    angles = np.arctan2(along[:, 1], along[:, 0])
    off_wall = OFF_WALL * np.column_stack([-np.sin(angles), np.cos(angles)])
    return starts[chosen] + along * random.random((ATTEMPTS, 1)) + off_wall, angles


def _standing_free(floor: Polygon, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Places anywhere in the floor's bounding box ``(attempts, 2)``, and directions about those of the walls."""
    x0, y0, x1, y1 = floor.bounds
    angles = random.integers(2, size=ATTEMPTS) * np.pi / 2 + random.normal(0, UNTIDY, size=ATTEMPTS)
    return random.uniform((x0, y0), (x1, y1), size=(ATTEMPTS, 2)), angles


def _prisms(area: BaseGeometry, bottom: float, top: float) -> list[trimesh.Trimesh]:
    """Prisms over the polygons of ``area`` between two heights."""
    lift = trimesh.transformations.translation_matrix([0, 0, bottom])
    parts = [part for part in shapely.get_parts(area) if isinstance(part, Polygon)]
    return [trimesh.creation.extrude_polygon(part, top - bottom, transform=lift) for part in parts]
