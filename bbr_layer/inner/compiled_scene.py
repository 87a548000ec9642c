"""A pair of clouds packed once for the compiled sweeps; the whole loop is compiled, but a large item goes in parts."""

import threading

import numpy as np
from torch import Tensor, ones_like

from bbr_layer.kernels import cpu_course
from bbr_layer.kernels.cpu import loss_of, pack
from bbr_layer.kernels.cpu_adam import Back, Course, Trace, advance, retreat
from bbr_layer.kernels.cpu_apart import normals_of
from bbr_layer.kernels.cpu_batch import DUAL, GRADIENT, Kept, Sweeps, parts_of, room_to_keep, run_item
from bbr_layer.kernels.cpu_course import Adjoint, Cloud
from bbr_layer.kernels.cpu_items import Tables
from bbr_layer.kernels.scene import Scene, SoftTerms
from bbr_layer.pair import CloudPair
from bbr_layer.trees import in_space


class CompiledScene:
    """The clouds as the sweeps read them; poses of the plane are embedded in space.

    Parameters
    ----------
    terms: which loss.
    pair: the clouds, the source not yet moved.
    rounding: ``(batch,)``.
    """

    def __init__(self, terms: SoftTerms, pair: CloudPair, rounding: Tensor):
        self.pair, self.rounding = pair, rounding.detach().double().numpy()
        self.feature_weight = terms.feature_weight
        self.packed = pack(terms, Scene(pair, ones_like(rounding), rounding))
        self.loss = loss_of(terms)
        self.batch, n, m = len(pair.P), pair.P.shape[1], pair.Q.shape[1]
        self.parted = parts_of(self.batch, n, m) > 1
        self.rooms = _Rooms()

    def walk(self, number: int, course: Course, trace: Trace) -> None:
        """Take item ``number`` along all steps of the course."""
        scene = self._item(number, GRADIENT)
        if not self.parted:
            cpu_course.walk(scene, course, trace)
            return
        for step, temperature in enumerate(course.temperatures):
            pose = trace.rotations[step], trace.translations[step]
            cpu_course.look(scene, pose, temperature)
            loss = run_item(GRADIENT, scene.tables, scene.kept, self.loss, self.batch)
            cpu_course.torque_and_force(scene.cloud, scene.tables.sums[1], pose, trace.gradients[step])
            advance(course, trace, step, loss)

    def walk_back(
        self,
        number: int,
        course: Course,
        trace: Trace,
        out: tuple[Back, Adjoint],
        by_course: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Take the cotangents of its last point back to the first; ``by_course`` gets the temperatures' and rates'."""
        scene = self._item(number, DUAL)
        self._walk_back(scene, course, trace, out, by_course)
        self.packed.settle(number, scene.tables)
        if self.packed.features is not None:
            adjoint, features = out[1], self.packed.features
            adjoint.P_features[:] += self.feature_weight * features.by_P[number].T
            adjoint.Q_features[:] += self.feature_weight * features.by_Q[number].T

    def _walk_back(
        self,
        scene: cpu_course.Scene,
        course: Course,
        trace: Trace,
        out: tuple[Back, Adjoint],
        by_course: tuple[np.ndarray, np.ndarray],
    ) -> None:
        if not self.parted:
            cpu_course.walk_back(scene, course, trace, out, by_course)
            return
        tables = scene.tables
        for step in reversed(range(len(course.temperatures))):
            along = retreat(course, trace, step, out[0], by_course[1])
            pose, temperature = (trace.rotations[step], trace.translations[step]), course.temperatures[step]
            cpu_course.look(scene, pose, temperature)
            cpu_course.set_going(scene.cloud, tables.sides[1], normals_of(tables.beside), pose, along)
            run_item(DUAL, tables, scene.kept, self.loss, self.batch)
            heat = cpu_course.spread(scene.cloud, tables.sums, tables.shares, (pose, along), out)
            by_course[0][step] = heat / temperature**2

    def _item(self, number: int, sweeps: Sweeps) -> cpu_course.Scene:
        points = _channels(self.pair.Q[number])
        normals = np.zeros_like(points) if self.pair.Q_normals is None else _channels(self.pair.Q_normals[number])
        real = np.ones(points.shape[1], dtype=bool) if self.pair.Q_mask is None else self.pair.Q_mask[number].numpy()
        tables = self.packed.item(number, pulled=sweeps.rates)
        cloud = Cloud(points, normals, real, float(self.rounding[number]))
        return cpu_course.Scene(cloud, tables, self._room(sweeps, tables), self.loss)

    def _room(self, sweeps: Sweeps, tables: Tables) -> Kept:
        of_thread = self.rooms.of_thread
        if sweeps.rates not in of_thread:
            of_thread[sweeps.rates] = room_to_keep(sweeps, tables)
        return of_thread[sweeps.rates]


class _Rooms(threading.local):
    """What the sweeps keep of an item, with rates or without: one room for each thread, whatever items it works on.

    Fresh memory for every item costs time, and threads wait for each other to get it.
    """

    def __init__(self) -> None:
        self.of_thread: dict[bool, Kept] = {}


def _channels(vectors: Tensor) -> np.ndarray:
    """``(n, d)`` as float64 channels ``(3, n)``."""
    return np.ascontiguousarray(in_space(vectors.detach().double().numpy()).T)
