"""F on its mutual pairs, compiled, looked at from one pose after the other; formulas as in ``kernels/matched.py``."""

from functools import partial

import numpy as np
from torch import Tensor

from bbr_layer.inner.adam_by_hand import Point, Totals
from bbr_layer.kernels.cpu_batch import side_by_side
from bbr_layer.kernels.cpu_matched import TANGENT, MatchedClouds, add_adjoint, add_weights, slope_of
from bbr_layer.kernels.matched import MatchedKernel
from bbr_layer.pair import CloudPair
from bbr_layer.trees import in_space


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
        vectors = (pair.P, pair.Q, *pair.both_normals())
        tables = [in_space(x.detach().double().numpy()) for x in vectors]
        for points, weights in ((pair.P, pair.P_weights), (pair.Q, pair.Q_weights)):
            tables.append(np.ones(points.shape[:2]) if weights is None else weights.detach().double().numpy())
        self.clouds = [MatchedClouds(*map(np.ascontiguousarray, item)) for item in zip(*tables, strict=True)]

    def totals(self) -> Totals:
        """Zeros, to be added to."""
        return Totals.zero(len(self.clouds), len(self.clouds[0].P), len(self.clouds[0].Q))

    def slope(self, at: Point, temperature: np.ndarray) -> np.ndarray:
        """The loss's gradient by a further turn and shift of the pose, ``(batch, 6)``."""
        slopes = np.zeros((len(self.clouds), TANGENT))
        side_by_side(partial(self._slope, at, temperature, slopes), len(self.clouds))
        return slopes

    def pull_back(
        self, at: Point, temperature: np.ndarray, along: np.ndarray, totals: Totals
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cotangents of ``along . slope``: of rotation, translation and temperature; the clouds' go to ``totals``."""
        found = np.zeros_like(at.rotation), np.zeros_like(at.translation), np.zeros(len(self.clouds))
        side_by_side(partial(self._pull_back, at, (temperature, along), totals, found), len(self.clouds))
        return found

    def _slope(self, at: Point, temperature: np.ndarray, slopes: np.ndarray, b: int) -> None:
        pose = _pose(at, b)
        slopes[b] = slope_of(self.clouds[b], self.search.of_item(b, pose), pose, temperature[b])

    def _pull_back(
        self,
        at: Point,
        heated: tuple[np.ndarray, np.ndarray],
        totals: Totals,
        found: tuple[np.ndarray, np.ndarray, np.ndarray],
        b: int,
    ) -> None:
        clouds, pose, (temperature, along) = self.clouds[b], _pose(at, b), heated
        pairs = self.search.of_item(b, pose)
        fields = totals.P, totals.Q, totals.P_normals, totals.Q_normals
        out = found[0][b], found[1][b], *(field[b] for field in fields)
        found[2][b], rates = add_adjoint(clouds, pairs, pose, (temperature[b], along[b]), out)
        add_weights(clouds, pairs, rates, totals.P_weights[b], totals.Q_weights[b])


def _pose(at: Point, b: int) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(at.rotation[b]), np.ascontiguousarray(at.translation[b])
