"""All steps of F on clouds of a few thousand points, compiled with the search between them; one item at a time."""

import numpy as np

from bbr_layer.kernels.cpu_adam import advance, retreat
from bbr_layer.kernels.cpu_compiling import exact
from bbr_layer.kernels.cpu_matched import slope_of
from bbr_layer.kernels.cpu_matched_adjoint import add_adjoint, add_weights
from bbr_layer.kernels.cpu_mutual import mutual_pairs

# F is a mean: what is rounding in its gradient does not hang on its value.
MEAN = 0.0


@exact
def _pairs(search, pose, index, mutual, counts):  # type: ignore[no-untyped-def]
    """The pairs at a pose into ``index`` and ``mutual``, in the rows of the clouds; ``counts (2, 3)`` grow.

    Parameters
    ----------
    search: both sides, as ``mutual_pairs`` wants them, and the rows of the clouds that are real.
    """
    forth, back, P_rows, Q_rows = search
    agreed, found = mutual_pairs(forth, back, pose)
    for side in range(2):
        for k in range(3):
            counts[side, k] += found[side][k]
    nearest = forth[3].found
    for j in range(len(Q_rows)):
        index[Q_rows[j]], mutual[Q_rows[j]] = P_rows[nearest[j]], agreed[j]


@exact
def walk(clouds, search, course, trace):  # type: ignore[no-untyped-def]
    """Take an item along all steps; how many neighbours each side was asked, searched and looked up, ``(2, 3)``."""
    index, mutual = np.zeros(len(clouds.Q), np.int64), np.zeros(len(clouds.Q), np.bool_)
    counts = np.zeros((2, 3), np.int64)
    for step in range(len(course.temperatures)):
        pose = trace.rotations[step], trace.translations[step]
        _pairs(search, pose, index, mutual, counts)
        slope = slope_of(clouds, (index, mutual), pose, course.temperatures[step])
        for k in range(len(slope)):
            trace.gradients[step, k] = slope[k]
        advance(course, trace, step, MEAN)
    return counts


@exact
def walk_back(clouds, search, course, trace, out):  # type: ignore[no-untyped-def]
    """The way back; ``out`` is (back, adjoint, cotangents of the temperatures, of the rates). Answers as ``walk``."""
    back, adjoint, by_temperatures, by_rates = out
    index, mutual = np.zeros(len(clouds.Q), np.int64), np.zeros(len(clouds.Q), np.bool_)
    counts = np.zeros((2, 3), np.int64)
    for step in range(len(course.temperatures) - 1, -1, -1):
        along = retreat(course, trace, step, back, by_rates)
        pose, temperature = (trace.rotations[step], trace.translations[step]), course.temperatures[step]
        _pairs(search, pose, index, mutual, counts)
        into = back.rotation, back.translation, adjoint.P, adjoint.Q, adjoint.P_normals, adjoint.Q_normals
        heat, rates = add_adjoint(clouds, (index, mutual), pose, (temperature, along), into)
        add_weights(clouds, (index, mutual), rates, adjoint.P_weights, adjoint.Q_weights)
        by_temperatures[step] = heat
    return counts
