"""Whether choices are mutual, mostly without anybody's exact neighbour; compiled.

A target point is some source point's nearest. Of the source points that chose it the nearest is its champion: no other
one can be mutual with it. One source point nearer than the champion denies that too, whichever is the nearest of all;
such a point is remembered, and found among the champion's own neighbours where there is one. Where no listed one is
nearer, the reach of the list proves the champion to be the nearest, or the whole cloud has to be searched.
"""

import numpy as np

from bbr_layer.kernels.cpu_compiling import exact
from bbr_layer.kernels.cpu_walk import UNKNOWN, look_up, placed, refresh_all, remember, squared_distance
from bbr_layer.trees import ROUNDING


@exact
def champions(index, distance, count):  # type: ignore[no-untyped-def]
    """Of those that chose each of ``count`` points the nearest, the first of several, and its distance; else -1.

    Parameters
    ----------
    index, distance: ``(m,)`` which one each chooses, and how far it is.
    """
    champion, nearest = np.full(count, -1), np.full(count, np.inf)
    for i in range(len(index)):
        row = index[i]
        if distance[i] < nearest[row]:
            champion[row], nearest[row] = i, distance[i]
    return champion, nearest


@exact
def _denied(lists, rival, place, squared):  # type: ignore[no-untyped-def]
    """A listed point that is nearer than the rival, or -1 and the least squared distance of the others."""
    x, y, z = place
    second = np.inf
    for k in range(lists.nearest.shape[1]):
        row = lists.nearest[rival, k]
        if row == rival:
            continue
        other = squared_distance(lists.points, row, x, y, z)
        if other * (1 + ROUNDING) < squared:
            return row, other
        second = min(second, other)
    return -1, second


@exact
def contest(lists, moving, pose, held, memory):  # type: ignore[no-untyped-def]
    """Bring the memory of chosen points up to date: the champion where it is the nearest, else any nearer one.

    Parameters
    ----------
    lists: of the cloud that chooses.
    moving: ``(n, 3)`` that are chosen, moved by ``pose``.
    held: what ``champions`` found.

    Returns
    -------
    How many were chosen, how many of them had to be searched for, and the rows that the lists cannot decide:
    those are in their places.
    """
    (rotation, translation), (champion, nearest), (found, reach, places, _) = pose, held, memory
    undecided, open_rows, asked, searched = np.empty(len(moving), np.int64), 0, 0, 0
    for i in range(len(moving)):
        rival = champion[i]
        if rival < 0:
            continue
        asked += 1
        place = placed(rotation, translation, moving, i)
        x, y, z = place
        own = nearest[i]
        if found[i] != rival:
            if squared_distance(lists.points, found[i], x, y, z) * (1 + ROUNDING) < own * own:
                continue
        elif (own + np.sqrt(squared_distance(places, i, x, y, z))) * (1 + ROUNDING) < reach[i]:
            continue
        searched += 1
        nearer, second = _denied(lists, rival, place, own * own)
        beyond = min(np.sqrt(second), lists.reach[rival] - own)
        if nearer >= 0:
            remember(memory, i, nearer, UNKNOWN, place)
        elif own * (1 + ROUNDING) < beyond:
            remember(memory, i, rival, beyond, place)
        else:
            remember(memory, i, found[i], UNKNOWN, place)
            undecided[open_rows] = i
            open_rows += 1
    return asked, searched, undecided[:open_rows]


@exact
def agreeing(index, back):  # type: ignore[no-untyped-def]
    """Whether each choice is returned, ``back[index[i]] == i``."""
    mutual = np.empty(len(index), np.bool_)
    for i in range(len(index)):
        mutual[i] = back[index[i]] == i
    return mutual


@exact
def _reversed(pose):  # type: ignore[no-untyped-def]
    rotation, translation = pose
    turned, shift = np.empty((3, 3)), np.empty(3)
    for a in range(3):
        for b in range(3):
            turned[a, b] = rotation[b, a]
        shift[a] = -(turned[a, 0] * translation[0] + turned[a, 1] * translation[1] + turned[a, 2] * translation[2])
    return turned, shift


@exact
def mutual_pairs(forth, back, pose):  # type: ignore[no-untyped-def]
    """Which choices of the moved points are mutual, and of each side how many were asked, searched for and looked up.

    What the lists leave open is compared with every point: for clouds of a few thousand.

    Parameters
    ----------
    forth, back: (lists, moving, wanted, memory) of the source in the target, of the target in the source.
    """
    reverse = _reversed(pose)
    first = refresh_all(forth[0], forth[1], pose, forth[2], forth[3])
    index, (lists, moving, _, memory) = forth[3].found, back
    held = champions(index, forth[3].distance, len(moving))
    asked, searched, rows = contest(lists, moving, reverse, held, memory)
    for i in rows:
        look_up(lists.points, i, memory)
    counts = (len(index), first[0], first[1]), (asked, searched, len(rows))
    return agreeing(index, memory.found), counts
