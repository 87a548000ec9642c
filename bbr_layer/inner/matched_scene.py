"""F on its mutual pairs, compiled, of large clouds but for the search; formulas as in ``kernels/matched.py``."""

import numpy as np
from torch import Tensor

from bbr_layer.kernels import cpu_matched_course
from bbr_layer.kernels.cpu_adam import Back, Course, Trace, advance, retreat
from bbr_layer.kernels.cpu_course import Adjoint
from bbr_layer.kernels.cpu_matched import matched_clouds, slope_of
from bbr_layer.kernels.cpu_matched_adjoint import add_adjoint, add_weights
from bbr_layer.kernels.cpu_matched_course import MEAN
from bbr_layer.kernels.matched import MatchedKernel
from bbr_layer.pair import CloudPair


class MatchedScene:
    """The clouds of F; poses of the plane are embedded in space.

    Parameters
    ----------
    kernel: knows the search.
    pair: the clouds, the source not yet moved.
    rounding: not used: F is rounded off by its temperature.
    """

    def __init__(self, kernel: MatchedKernel, pair: CloudPair, rounding: Tensor):
        self.search = kernel.search
        self.clouds = matched_clouds(pair, kernel.reach)

    def walk(self, number: int, course: Course, trace: Trace) -> None:
        """Take item ``number`` along all steps of the course."""
        clouds, tables = self.clouds[number], self.search.tables(number)
        if tables is not None:
            self.search.count(number, cpu_matched_course.walk(clouds, tables, course, trace))
            return
        for step, temperature in enumerate(course.temperatures):
            pose = trace.rotations[step], trace.translations[step]
            trace.gradients[step] = slope_of(clouds, self.search.of_item(number, pose), pose, temperature)
            advance(course, trace, step, MEAN)

    def walk_back(
        self,
        number: int,
        course: Course,
        trace: Trace,
        out: tuple[Back, Adjoint],
        by_course: tuple[np.ndarray, np.ndarray],
    ) -> None:
        """Take the cotangents of its last point back to the first; ``by_course`` gets the temperatures' and rates'."""
        clouds, tables, (back, adjoint) = self.clouds[number], self.search.tables(number), out
        if tables is not None:
            whole = back, adjoint, *by_course
            self.search.count(number, cpu_matched_course.walk_back(clouds, tables, course, trace, whole))
            return
        by_clouds = adjoint.P, adjoint.Q, adjoint.P_normals, adjoint.Q_normals
        for step in reversed(range(len(course.temperatures))):
            along = retreat(course, trace, step, back, by_course[1])
            pose, temperature = (trace.rotations[step], trace.translations[step]), course.temperatures[step]
            pairs = self.search.of_item(number, pose)
            by_pose = back.rotation, back.translation
            heat, rates = add_adjoint(clouds, pairs, pose, (temperature, along), (*by_pose, *by_clouds))
            add_weights(clouds, pairs, rates, adjoint.P_weights, adjoint.Q_weights)
            by_course[0][step] = heat
