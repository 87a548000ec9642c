"""F on its mutual pairs in numpy, looked at from one pose after the other; formulas as in ``kernels/matched.py``."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.adam_by_hand import Point, Totals, axial, hat
from bbr_layer.kernels.matched import MatchedKernel
from bbr_layer.pair import CloudPair
from bbr_layer.trees import in_space


class _Pairs(NamedTuple):
    """The b mutual pairs of one item, turned into the target's frame; ``(b, 3)`` and ``(b,)``."""

    rows: np.ndarray  # of P
    columns: np.ndarray  # of Q
    points: np.ndarray  # of Q, before the motion
    normals: np.ndarray
    arms: np.ndarray  # the same after the rotation
    turned: np.ndarray
    offsets: np.ndarray  # from P to the moved Q
    planes: np.ndarray  # n_q + s n_p
    signs: np.ndarray
    residual: np.ndarray
    inverse: np.ndarray  # of the rounded distance; 0 at 0
    weights: np.ndarray  # of the two points, divided by the sum over all pairs
    shares: tuple[np.ndarray, np.ndarray]  # the same without the weight of P's point, and of Q's


class MatchedScene:
    """The clouds of F; poses of the plane are embedded in space.

    Parameters
    ----------
    kernel: knows the search.
    pair: the clouds, the source not yet moved.
    rounding: not used: F is rounded off by its temperature.
    """

    def __init__(self, kernel: MatchedKernel, pair: CloudPair, rounding: Tensor):
        self.search, self.d = kernel.search, pair.P.shape[-1]
        P_normals, Q_normals = pair.both_normals()
        self.P, self.Q, self.P_normals, self.Q_normals = (
            in_space(vectors.detach().double().numpy()) for vectors in (pair.P, pair.Q, P_normals, Q_normals)
        )
        self.P_weights, self.Q_weights = (
            np.ones(points.shape[:2]) if weights is None else weights.detach().double().numpy()
            for points, weights in ((self.P, pair.P_weights), (self.Q, pair.Q_weights))
        )

    def totals(self) -> Totals:
        """Zeros, to be added to."""
        return Totals.zero(len(self.P), self.P.shape[1], self.Q.shape[1])

    def slope(self, at: Point, temperature: np.ndarray) -> np.ndarray:
        """The loss's gradient by a further turn and shift of the pose, ``(batch, 6)``."""
        slopes = []
        for pairs in self._pairs(at, temperature):
            push = (pairs.weights * pairs.inverse * pairs.residual)[:, None]
            force = push * pairs.planes
            outer = force.T @ pairs.arms + (push * pairs.offsets).T @ pairs.turned
            slopes.append(np.concatenate((axial(outer[None])[0], force.sum(axis=0))))
        return np.stack(slopes)

    def pull_back(
        self, at: Point, temperature: np.ndarray, along: np.ndarray, totals: Totals
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cotangents of ``along . slope``: of rotation, translation and temperature; the clouds' go to ``totals``."""
        rotation, translation, heat = np.zeros_like(at.rotation), np.zeros_like(at.translation), np.zeros(len(self.P))
        for b, pairs in enumerate(self._pairs(at, temperature)):
            turning = hat(along[b : b + 1, :3])[0]
            velocity, spin = pairs.arms @ turning.T + along[b, 3:], pairs.turned @ turning.T
            residual_rate = (velocity * pairs.planes + pairs.offsets * spin).sum(axis=1)
            distance_rate = pairs.residual * residual_rate * pairs.inverse
            over = pairs.weights * pairs.inverse
            over_rate = -over * distance_rate * pairs.inverse
            push, push_rate = over * pairs.residual, over_rate * pairs.residual + over * residual_rate
            forces = push[:, None] * pairs.planes, push_rate[:, None] * pairs.planes + push[:, None] * spin
            torques = push[:, None] * pairs.offsets, push_rate[:, None] * pairs.offsets + push[:, None] * velocity
            pull, twist = forces[1] - forces[0] @ turning.T, torques[1] - torques[0] @ turning.T
            rotation[b] = pull.T @ pairs.points + twist.T @ pairs.normals
            translation[b], heat[b] = forces[1].sum(axis=0), temperature[b] * over_rate.sum()
            totals.Q[b][:, pairs.columns] += (pull @ at.rotation[b]).T
            totals.Q_normals[b][:, pairs.columns] += (twist @ at.rotation[b]).T
            totals.P[b][:, pairs.rows] -= forces[1].T
            totals.P_normals[b][:, pairs.rows] += (pairs.signs[:, None] * torques[1]).T
            excess = distance_rate - (pairs.weights * distance_rate).sum()
            totals.P_weights[b][pairs.rows] += excess * pairs.shares[0]
            totals.Q_weights[b][pairs.columns] += excess * pairs.shares[1]
        return rotation, translation, heat

    def _pairs(self, at: Point, temperature: np.ndarray) -> list[_Pairs]:
        """The mutual pairs of every item at a pose."""
        d = self.d
        pose = RigidMotion(*(torch.from_numpy(x) for x in (at.rotation[:, :d, :d], at.translation[:, :d])))
        found = [x.numpy() for x in self.search(pose)]
        return [self._item(b, (at.rotation[b], at.translation[b]), temperature[b], found) for b in range(len(self.P))]

    def _item(self, b: int, pose: tuple[np.ndarray, np.ndarray], temperature: float, found: list[np.ndarray]) -> _Pairs:
        columns = np.flatnonzero(found[1][b])
        rows = found[0][b][columns]
        points, normals, facing = self.Q[b][columns], self.Q_normals[b][columns], self.P_normals[b][rows]
        arms, turned = points @ pose[0].T, normals @ pose[0].T
        signs = np.where((facing * turned).sum(axis=1) < 0, -1.0, 1.0)
        offsets, planes = arms + pose[1] - self.P[b][rows], turned + signs[:, None] * facing
        residual = (offsets * planes).sum(axis=1)
        distances = np.sqrt(residual**2 + temperature**2)
        inverse = np.divide(1.0, distances, out=np.zeros_like(distances), where=distances > 0)
        own, other = self.P_weights[b][rows], self.Q_weights[b][columns]
        total = (own * other).sum()
        scale = 1 / total if total > 0 else 0.0
        shares, weights = (other * scale, own * scale), own * other * scale
        return _Pairs(
            rows, columns, points, normals, arms, turned, offsets, planes, signs, residual, inverse, weights, shares
        )
