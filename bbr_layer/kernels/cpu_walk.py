"""Nearest neighbours that moved only a little, found by walking from the last one; exact, compiled.

Every point of the searched cloud knows its k nearest and the distance of the last of them. From where the neighbour
was, the walk goes to whichever listed point is nearer until none is. At a distance ``d`` from a point whose list
reaches to ``r``, every point that is not listed is at least ``r - d`` away: if that is more than ``d``, the walk has
ended at the nearest of all.
"""

from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_compiling import exact
from bbr_layer.trees import ROUNDING

UNKNOWN = -1.0  # reach of a neighbour that nothing is known of


class Lists(NamedTuple):
    """The searched cloud.

    Parameters
    ----------
    points: ``(n, 3)``.
    nearest: ``(n, k)`` int32, each point's k nearest, itself among them.
    reach: ``(n,)`` no point outside the list is nearer; infinite where the list holds all points.
    """

    points: np.ndarray
    nearest: np.ndarray
    reach: np.ndarray


class Memory(NamedTuple):
    """What is known of the moving points.

    Parameters
    ----------
    found: ``(m,)`` the nearest point when last searched for.
    reach: ``(m,)`` no other point was nearer than this then, or ``UNKNOWN``.
    places: ``(m, 3)`` where the moving point was.
    distance: ``(m,)`` of the nearest point now, where it was wanted.
    """

    found: np.ndarray
    reach: np.ndarray
    places: np.ndarray
    distance: np.ndarray


@exact
def placed(rotation, translation, points, row):  # type: ignore[no-untyped-def]
    x, y, z = points[row, 0], points[row, 1], points[row, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0],
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1],
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2],
    )


@exact
def squared_distance(points, row, x, y, z):  # type: ignore[no-untyped-def]
    dx, dy, dz = x - points[row, 0], y - points[row, 1], z - points[row, 2]
    return dx * dx + dy * dy + dz * dz


@exact
def remember(memory, row, at, reach, place):  # type: ignore[no-untyped-def]
    """That of a moved point at this place the nearest is ``at``, and no other one nearer than ``reach``."""
    memory.found[row], memory.reach[row] = at, reach
    for axis in range(3):
        memory.places[row, axis] = place[axis]


@exact
def _walk(points, nearest, start, place):  # type: ignore[no-untyped-def]
    """Where the walk from ``start`` ends, its squared distance, and that of the next one in the last list."""
    x, y, z = place
    here, best, second = start, squared_distance(points, start, x, y, z), np.inf
    while True:
        at, second = here, np.inf
        for k in range(nearest.shape[1]):
            row = nearest[at, k]
            if row == at:
                continue
            squared = squared_distance(points, row, x, y, z)
            if squared < best:
                here, best, second = row, squared, best
            elif squared < second:
                second = squared
        if here == at:
            return here, best, second


@exact
def refresh(lists, moving, pose, wanted, memory):  # type: ignore[no-untyped-def]
    """Bring the wanted neighbours of moved points up to date.

    Parameters
    ----------
    moving: ``(m, 3)``, moved by ``pose = (rotation, translation)``.

    Returns
    -------
    How many were searched for, and the rows that the walk cannot decide: those are in their places.
    """
    (points, nearest, listed), (rotation, translation), (found, reach, places, distance) = lists, pose, memory
    undecided, open_rows, searched = np.empty(len(moving), np.int64), 0, 0
    for i in range(len(moving)):
        if not wanted[i]:
            continue
        place = placed(rotation, translation, moving, i)
        x, y, z = place
        own, moved = np.sqrt(squared_distance(points, found[i], x, y, z)), np.sqrt(squared_distance(places, i, x, y, z))
        distance[i] = own
        if (own + moved) * (1 + ROUNDING) < reach[i]:
            continue
        searched += 1
        # The first search of all has nothing to walk from.
        decided = reach[i] >= 0
        if decided:
            at, best, second = _walk(points, nearest, found[i], place)
            own = np.sqrt(best)
            beyond = min(np.sqrt(second), listed[at] - own)
            decided = own * (1 + ROUNDING) < beyond
        if decided:
            distance[i] = own
            remember(memory, i, at, beyond, place)
        else:
            remember(memory, i, found[i], UNKNOWN, place)
            undecided[open_rows] = i
            open_rows += 1
    return searched, undecided[:open_rows]


@exact
def look_up(points, row, memory):  # type: ignore[no-untyped-def]
    """Compare a moved point, at its place, with every one: the first of the nearest, and the reach beyond it."""
    x, y, z = memory.places[row]
    here, best = 0, np.inf
    for other in range(len(points)):
        squared = squared_distance(points, other, x, y, z)
        if squared < best:
            here, best = other, squared
    second = np.inf
    for other in range(len(points)):
        squared = squared_distance(points, other, x, y, z)
        if squared < second and squared_distance(points, other, points[here, 0], points[here, 1], points[here, 2]) > 0:
            second = squared
    memory.found[row], memory.reach[row], memory.distance[row] = here, np.sqrt(second), np.sqrt(best)


@exact
def refresh_all(lists, moving, pose, wanted, memory):  # type: ignore[no-untyped-def]
    """``refresh``, and what the walk cannot decide is compared with every point: for clouds of a few thousand.

    Returns
    -------
    How many were searched for, and how many of those in the whole cloud.
    """
    searched, rows = refresh(lists, moving, pose, wanted, memory)
    for row in rows:
        look_up(lists.points, row, memory)
    return searched, len(rows)
