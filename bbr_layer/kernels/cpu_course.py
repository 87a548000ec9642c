"""Steps of Adam on a soft loss of one item, and their adjoint: the whole loop compiled.

Formulas: the loss's gradient by a further turn and shift of the pose is the torque and force of the column forces; its
directional derivative along a cotangent is the adjoint of that (``inner.pose_gradient``).
"""

from typing import NamedTuple

import numpy as np

from bbr_layer.kernels.cpu_adam import advance, retreat
from bbr_layer.kernels.cpu_apart import normals_of
from bbr_layer.kernels.cpu_compiling import exact
from bbr_layer.kernels.cpu_items import Loss, Tables, item_gradient, item_rates
from bbr_layer.kernels.cpu_math import COLUMN_OUT, COOL, HEAT, ROUND, ROW_OUT, VELOCITY
from bbr_layer.kernels.cpu_turns import apply, apply_transposed, cross


class Cloud(NamedTuple):
    """The source of one item before it moves, float64.

    Parameters
    ----------
    points, normals: ``(3, m)``; normals are zeros where the loss has none.
    real: ``(m,)`` bool, False where padded: those columns stay where they are.
    rounding: the smoothing length.
    """

    points: np.ndarray
    normals: np.ndarray
    real: np.ndarray
    rounding: float


class Scene(NamedTuple):
    """One item under one loss; ``kept`` is room for what the first sweep keeps, or None."""

    cloud: Cloud
    tables: Tables
    kept: tuple[np.ndarray, ...] | None
    loss: Loss


class Adjoint(NamedTuple):
    """Where cotangents of one item are added up: ``(3, n)``, ``(3, m)``, normals alike, weights, rounding ``(1,)``.

    Those of features, ``(c, n)`` and ``(c, m)``, are put there when all steps are done.
    """

    P: np.ndarray
    Q: np.ndarray
    P_normals: np.ndarray
    Q_normals: np.ndarray
    P_weights: np.ndarray
    Q_weights: np.ndarray
    rounding: np.ndarray
    P_features: np.ndarray
    Q_features: np.ndarray


@exact
def at(table, j):  # type: ignore[no-untyped-def]
    """Column ``j`` of three channels."""
    return table[0, j], table[1, j], table[2, j]


@exact
def place(cloud, columns, normals, pose):  # type: ignore[no-untyped-def]
    """Put the columns, and their normals unless None, where the pose has them."""
    rotation, shift = pose
    for j in range(columns.shape[1]):
        if cloud.real[j]:
            arm = apply(rotation, at(cloud.points, j))
            for k in range(3):
                columns[k, j] = arm[k] + shift[k]
            if normals is not None:
                turned = apply(rotation, at(cloud.normals, j))
                for k in range(3):
                    normals[1][k, j] = turned[k]


@exact
def torque_and_force(cloud, forces, pose, out):  # type: ignore[no-untyped-def]
    """The gradient ``out (6,)`` by a turn and shift, from forces on columns and on their normals ``(6, m)``."""
    rotation, _ = pose
    out[:] = 0
    for j in range(len(cloud.real)):
        if cloud.real[j]:
            force = at(forces, j)
            by_arm = cross(apply(rotation, at(cloud.points, j)), force)
            by_normal = cross(apply(rotation, at(cloud.normals, j)), at(forces[3:], j))
            for k in range(3):
                out[k] += by_arm[k] + by_normal[k]
                out[3 + k] += force[k]


@exact
def set_going(cloud, columns, normals, pose, along):  # type: ignore[no-untyped-def]
    """Velocities of the columns, and of their normals unless None, along a turn and shift ``(6,)``."""
    rotation, turn = pose[0], (along[0], along[1], along[2])
    for j in range(columns.shape[1]):
        if cloud.real[j]:
            velocity = cross(turn, apply(rotation, at(cloud.points, j)))
            for k in range(3):
                columns[VELOCITY + k, j] = velocity[k] + along[3 + k]
            if normals is not None:
                spin = cross(turn, apply(rotation, at(cloud.normals, j)))
                for k in range(3):
                    normals[1][3 + k, j] = spin[k]


@exact
def _pulled(cloud, sums, channel, j, moved):  # type: ignore[no-untyped-def]
    """Rate of the force in ``channel`` on column ``j``, as seen from the turning frame, into rotation and own frame."""
    turn, rotation, by_rotation, own, table = moved
    spun = cross(turn, at(sums[channel:], j))
    rate = at(sums[COLUMN_OUT + channel :], j)
    pull = rate[0] - spun[0], rate[1] - spun[1], rate[2] - spun[2]
    back = apply_transposed(rotation, pull)
    for k in range(3):
        own[k, j] += back[k]
        for axis in range(3):
            by_rotation[k, axis] += pull[k] * table[axis, j]


@exact
def spread(cloud, sums, shares, moved, out):  # type: ignore[no-untyped-def]
    """Add what the rates of all sums say to ``out = (Back, Adjoint)``; answers with the heat's.

    ``moved`` is (pose, along).
    """
    (row_sums, column_sums), (row_shares, column_shares), (back, adjoint), (pose, along) = sums, shares, out, moved
    turn, heat, rounding = (along[0], along[1], along[2]), 0.0, 0.0
    for j in range(len(cloud.real)):
        if cloud.real[j]:
            _pulled(cloud, column_sums, 0, j, (turn, pose[0], back.rotation, adjoint.Q, cloud.points))
            _pulled(cloud, column_sums, 3, j, (turn, pose[0], back.rotation, adjoint.Q_normals, cloud.normals))
            for k in range(3):
                back.translation[k] += column_sums[COLUMN_OUT + k, j]
        adjoint.Q_weights[j] += column_shares[1, j]
    for i in range(row_sums.shape[1]):
        for k in range(3):
            adjoint.P[k, i] += row_sums[ROW_OUT + k, i]
            adjoint.P_normals[k, i] += row_sums[ROW_OUT + 3 + k, i]
        adjoint.P_weights[i] += row_shares[1, i]
        heat += row_sums[ROW_OUT + HEAT, i]
        rounding += row_sums[ROW_OUT + ROUND, i]
    adjoint.rounding[0] += cloud.rounding * rounding
    return heat


@exact
def look(scene, pose, temperature):  # type: ignore[no-untyped-def]
    """Place the source, and set the temperature."""
    place(scene.cloud, scene.tables.sides[1], normals_of(scene.tables.beside), pose)
    scene.tables.constants[COOL] = 1 / temperature


@exact
def walk(scene, course, trace):  # type: ignore[no-untyped-def]
    """Take all steps of the course, from the trace's first point on."""
    for step in range(len(course.temperatures)):
        pose = trace.rotations[step], trace.translations[step]
        look(scene, pose, course.temperatures[step])
        loss = item_gradient(scene.tables, scene.kept, scene.loss)
        torque_and_force(scene.cloud, scene.tables.sums[1], pose, trace.gradients[step])
        advance(course, trace, step, loss)


@exact
def walk_back(scene, course, trace, out, by_course):  # type: ignore[no-untyped-def]
    """Take the cotangents ``out = (Back, Adjoint)`` back to the trace's first point.

    ``by_course`` gets those of the temperatures ``(steps,)`` and of the rates ``(steps, 6)``.
    """
    tables = scene.tables
    for step in range(len(course.temperatures) - 1, -1, -1):
        along = retreat(course, trace, step, out[0], by_course[1])
        pose, temperature = (trace.rotations[step], trace.translations[step]), course.temperatures[step]
        look(scene, pose, temperature)
        set_going(scene.cloud, tables.sides[1], normals_of(tables.beside), pose, along)
        item_rates(tables, scene.kept, scene.loss)
        by_course[0][step] = spread(scene.cloud, tables.sums, tables.shares, (pose, along), out) / temperature**2
