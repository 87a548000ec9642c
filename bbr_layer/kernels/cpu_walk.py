"""Nearest neighbours that moved only a little, found by walking from the last one; exact, compiled.

Every point of the searched cloud knows its k nearest and the distance of the last of them. From where the neighbour
was, the walk goes to whichever listed point is nearer until none is. At a distance ``d`` from a point whose list
reaches to ``r``, every point that is not listed is at least ``r - d`` away: if that is more than ``d``, the walk has
ended at the nearest of all.
"""

from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_math import exact
from bbr_layer.trees import ROUNDING


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
    reach: ``(m,)`` no other point was nearer than this then; -1: never searched for.
    places: ``(m, 3)`` where the moving point was.
    """

    found: np.ndarray
    reach: np.ndarray
    places: np.ndarray


@exact
def _moved(rotation, translation, points, row):  # type: ignore[no-untyped-def]
    x, y, z = points[row, 0], points[row, 1], points[row, 2]
    return (
        rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0],
        rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1],
        rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2],
    )


@exact
def _squared(points, row, x, y, z):  # type: ignore[no-untyped-def]
    dx, dy, dz = x - points[row, 0], y - points[row, 1], z - points[row, 2]
    return dx * dx + dy * dy + dz * dz


@exact
def _walk(points, nearest, start, place):  # type: ignore[no-untyped-def]
    """Where the walk from ``start`` ends, its squared distance, and that of the next one in the last list."""
    x, y, z = place
    here, best, second = start, _squared(points, start, x, y, z), np.inf
    while True:
        at, second = here, np.inf
        for k in range(nearest.shape[1]):
            row = nearest[at, k]
            if row == at:
                continue
            squared = _squared(points, row, x, y, z)
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
    How many were searched for, and the rows that the walk cannot decide.
    """
    (points, nearest, listed), (rotation, translation), (found, reach, places) = lists, pose, memory
    undecided, open_rows, searched = np.empty(len(moving), np.int64), 0, 0
    for i in range(len(moving)):
        if not wanted[i]:
            continue
        x, y, z = _moved(rotation, translation, moving, i)
        own, moved = np.sqrt(_squared(points, found[i], x, y, z)), np.sqrt(_squared(places, i, x, y, z))
        if (own + moved) * (1 + ROUNDING) < reach[i]:
            continue
        searched += 1
        # The first search of all has nothing to walk from.
        decided = reach[i] >= 0
        if decided:
            at, best, second = _walk(points, nearest, found[i], (x, y, z))
            own = np.sqrt(best)
            beyond = min(np.sqrt(second), listed[at] - own)
            decided = own * (1 + ROUNDING) < beyond
        if decided:
            found[i], reach[i] = at, beyond
            places[i, 0], places[i, 1], places[i, 2] = x, y, z
        else:
            undecided[open_rows] = i
            open_rows += 1
    return searched, undecided[:open_rows]


@exact
def marked(index, count):  # type: ignore[no-untyped-def]
    """``(count,)`` True at every index that occurs."""
    chosen = np.zeros(count, np.bool_)
    for i in range(len(index)):
        chosen[index[i]] = True
    return chosen


@exact
def agreeing(index, back):  # type: ignore[no-untyped-def]
    """Whether each choice is returned, ``back[index[i]] == i``."""
    mutual = np.empty(len(index), np.bool_)
    for i in range(len(index)):
        mutual[i] = back[index[i]] == i
    return mutual


@exact
def _look_up(points, place):  # type: ignore[no-untyped-def]
    """The first of the nearest points, its squared distance, and that of the nearest one that lies elsewhere."""
    x, y, z = place
    here, best = 0, np.inf
    for row in range(len(points)):
        squared = _squared(points, row, x, y, z)
        if squared < best:
            here, best = row, squared
    second = np.inf
    for row in range(len(points)):
        squared = _squared(points, row, x, y, z)
        if squared < second and _squared(points, row, points[here, 0], points[here, 1], points[here, 2]) > 0:
            second = squared
    return here, best, second


@exact
def refresh_all(lists, moving, pose, wanted, memory):  # type: ignore[no-untyped-def]
    """``refresh``, and what the walk cannot decide is compared with every point: for clouds of a few thousand.

    Returns
    -------
    How many were searched for, and how many of those in the whole cloud.
    """
    searched, rows = refresh(lists, moving, pose, wanted, memory)
    rotation, translation = pose
    for i in rows:
        x, y, z = _moved(rotation, translation, moving, i)
        memory.found[i], _, second = _look_up(lists.points, (x, y, z))
        memory.reach[i] = np.sqrt(second)
        memory.places[i, 0], memory.places[i, 1], memory.places[i, 2] = x, y, z
    return searched, len(rows)


@exact
def mutual_pairs(forth, back, pose):  # type: ignore[no-untyped-def]
    """Which choices of the moved points are mutual, and of each side how many were asked, searched for and looked up.

    Parameters
    ----------
    forth, back: (lists, moving, wanted, memory) of the source in the target, of the target in the source.
    """
    rotation, translation = pose
    turned = np.ascontiguousarray(rotation.T)
    reverse = turned, -(turned @ translation)
    first = refresh_all(forth[0], forth[1], pose, forth[2], forth[3])
    index = forth[3].found
    wanted = marked(index, len(back[1]))
    second = refresh_all(back[0], back[1], reverse, wanted, back[3])
    counts = (len(index), first[0], first[1]), (np.sum(wanted), second[0], second[1])
    return agreeing(index, back[3].found), counts
