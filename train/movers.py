"""People and trolleys that move while the world is scanned, in metres."""

from dataclasses import dataclass

import numpy as np
import shapely
import trimesh
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from shapely.geometry.base import BaseGeometry

from train.routes import Route
from train.world_settings import WorldSettings

# Radius and height of a walking person, and length, width and height of a trolley. Metres.
PERSON = (0.25, 1.7)
TROLLEY = (0.8, 0.5, 1.0)
SHARE_OF_PEOPLE = 0.6
# Metres: how near a pacer may come to the sensor, within what distance it counts as met, its shortest walk,
# how far from the robot's way its turning points are drawn, and how far from walls and furniture it stays.
KEPT_AWAY = 0.7
MET_WITHIN = 4.0
SHORTEST_WALK = 1.5
SPREAD = 1.5
KEPT_FROM_WALLS = 0.3
# Walks drawn for one pacer, how many of them are compared, and speeds in metres per scan (half a second).
DRAWN = 2000
COMPARED = 100
SPEEDS = (0.3, 0.7)
# A companion is this many scans ahead of or behind the robot, swinging by a part of it over this many scans.
AHEAD = (3.5, 6.0)
SWING = 0.15
SWING_PERIOD = 17.0
FARTHEST_COMPANION = AHEAD[1] * (1 + SWING)


@dataclass(frozen=True)
class Mover:
    """A ``solid`` about its own origin; at each scan a position ``(k, 2)`` and heading ``(k,)``, radians."""

    solid: trimesh.Trimesh
    positions: Float[np.ndarray, "k 2"]
    headings: Float[np.ndarray, "k"]

    def into_own_frame(
        self, scan: int, points: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """World ``points`` and ``directions`` as the mover sees them at ``scan``."""
        rotation = Rotation.from_euler("z", self.headings[scan]).inv()
        return rotation.apply(points - [*self.positions[scan], 0.0]), rotation.apply(directions)


def draw_movers(
    open_floor: BaseGeometry, route: Route, times: Float[np.ndarray, "k"], settings: WorldSettings
) -> list[Mover]:
    """``settings.movers`` movers on ``open_floor`` while the robot is on ``route`` at each scan's ``times``.

    Every second one is a companion who leads or follows the robot through the doors; the others walk to and
    fro in its sight and stay ``KEPT_AWAY`` from it where there is room.
    """
    random = settings.random("movers")
    robot, _ = route.at(times)
    shapely.prepare(open_floor)
    movers = []
    for index in range(settings.movers):
        walk = _companion(route, times, random) if index % 2 else _pacer(open_floor, robot, random)
        movers.append(Mover(_solid(random), *walk))
    return movers


def _solid(random: np.random.Generator) -> trimesh.Trimesh:
    """A person, as a cylinder, or a trolley, as a box; its lowest point at z = 0."""
    if random.random() < SHARE_OF_PEOPLE:
        radius, height = PERSON
        solid = trimesh.creation.cylinder(radius, height, sections=20)
    else:
        *_, height = TROLLEY
        solid = trimesh.creation.box(TROLLEY)
    solid.apply_translation([0, 0, height / 2])
    return solid


def _companion(
    route: Route, times: Float[np.ndarray, "k"], random: np.random.Generator
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
    """Ahead of or behind the robot on its own way, now a little nearer, now a little farther."""
    lead = random.uniform(*AHEAD) * random.choice([-1, 1])
    swing = 1 + SWING * np.sin(2 * np.pi * (np.arange(len(times)) / SWING_PERIOD + random.random()))
    return route.at(times + lead * swing)


def _pacer(
    open_floor: BaseGeometry, robot: Float[np.ndarray, "k 2"], random: np.random.Generator
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
    """To and fro between two places; of many such walks, the one that is most often in the robot's sight."""
    ends = robot[random.integers(len(robot), size=(DRAWN, 2))] + random.normal(0, SPREAD, size=(DRAWN, 2, 2))
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1, keepdims=True)
    starts, speeds = random.uniform(0, 2, size=(DRAWN, 1)), random.uniform(*SPEEDS, size=(DRAWN, 1))
    shares = np.abs((starts + np.arange(len(robot)) * speeds / lengths) % 2 - 1)[..., None]
    walks = ends[:, None, 0] * shares + ends[:, None, 1] * (1 - shares)
    away = np.linalg.norm(walks - robot, axis=-1)

    inside = open_floor.buffer(-KEPT_FROM_WALLS)
    shapely.prepare(inside)
    walkable = shapely.covers(inside, shapely.linestrings(ends)) & (lengths[:, 0] > SHORTEST_WALK)
    # The walks that can be walked, those that keep away from the robot first.
    order = np.argsort(-np.minimum(away.min(axis=1), KEPT_AWAY) - 10.0 * walkable, kind="stable")[:COMPARED]
    sights = shapely.linestrings(np.stack([walks[order], np.broadcast_to(robot, walks[order].shape)], axis=-2))
    met = shapely.covers(open_floor, sights) & (away[order] < MET_WITHIN)
    kept = walkable[order] & (away[order].min(axis=1) >= KEPT_AWAY)
    best = order[np.argmax(met.sum(axis=1) * kept)]
    direction = ends[best, 1] - ends[best, 0]
    return walks[best], np.full(len(robot), np.arctan2(direction[1], direction[0]))
