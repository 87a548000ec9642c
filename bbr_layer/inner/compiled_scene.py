"""A pair of clouds packed once for the compiled sweeps, and looked at from one pose after the other."""

import numpy as np
import torch
from torch import Tensor

from bbr_layer.inner.adam_by_hand import Point, Totals, axial, hat, transposed
from bbr_layer.kernels.cpu import FAR, LONG_NORMAL, pack
from bbr_layer.kernels.cpu_batch import DUAL, GRADIENT, Sums, run_sweeps
from bbr_layer.kernels.cpu_math import COLUMN_OUT, COOL, HEAT, ROUND, ROW_OUT, VELOCITY
from bbr_layer.kernels.scene import Scene, SoftTerms
from bbr_layer.pair import CloudPair


class CompiledScene:
    """The clouds as the sweeps read them; poses of the plane are embedded in space.

    Parameters
    ----------
    terms: which loss.
    pair: the clouds, the source not yet moved.
    rounding: ``(batch,)``.
    """

    def __init__(self, terms: SoftTerms, pair: CloudPair, rounding: Tensor):
        self.terms, self.rounding = terms, rounding.detach().double().numpy()
        self.packed = pack(terms, Scene(pair, torch.ones_like(rounding), rounding))
        self.padded = None if pair.Q_mask is None else ~pair.Q_mask.numpy()[:, None]
        self.points = self._unpadded(self.packed.columns[:, :3])
        normals = self.packed.column_normals
        self.normals = None if normals is None else self._unpadded(normals[:, :3])

    def totals(self) -> Totals:
        """Zeros, to be added to."""
        return Totals.zero(len(self.packed.rows), self.packed.rows.shape[2], self.points.shape[2])

    def slope(self, at: Point, temperature: np.ndarray) -> np.ndarray:
        """The loss's gradient by a further turn and shift of the pose, ``(batch, 6)``."""
        arms, normals = self._place(at, temperature)
        sums = run_sweeps(GRADIENT, self.packed, self.terms.outlier, self.terms.mean)
        forces = sums.columns[:, :3]
        outer = forces @ transposed(arms)
        if normals is not None:
            outer += sums.columns[:, 3:6] @ transposed(normals)
        return np.concatenate((axial(outer), forces.sum(axis=2)), axis=1)

    def pull_back(
        self, at: Point, temperature: np.ndarray, along: np.ndarray, totals: Totals
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Cotangents of ``along . slope``, ``along (batch, 6)``: of rotation, translation and temperature.

        Those of the clouds are added to ``totals``.
        """
        arms, normals = self._place(at, temperature)
        turning = hat(along[:, :3])
        velocity = turning @ arms + along[:, 3:, None]
        self.packed.columns[:, VELOCITY : VELOCITY + 3] = self._unpadded(velocity)
        if normals is not None and self.packed.column_normals is not None:
            self.packed.column_normals[:, 3:] = turning @ normals
        sums = run_sweeps(DUAL, self.packed, self.terms.outlier, self.terms.mean)
        rates = sums.columns[:, COLUMN_OUT:]
        pull = self._unpadded(rates[:, :3] - turning @ sums.columns[:, :3])
        rotation = pull @ transposed(self.points)
        totals.Q[:] += transposed(at.rotation) @ pull
        if self.normals is not None:
            torque = self._unpadded(rates[:, 3:6] - turning @ sums.columns[:, 3:6])
            rotation += torque @ transposed(self.normals)
            totals.Q_normals[:] += transposed(at.rotation) @ torque
        self._add(sums, totals)
        heat = sums.rows[:, ROW_OUT + HEAT].sum(axis=1) / temperature**2
        return rotation, self._unpadded(rates[:, :3]).sum(axis=2), heat

    def _place(self, at: Point, temperature: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Put the source where the pose has it; its points about the translation, and its normals, turned."""
        arms = at.rotation @ self.points
        moved, normals = arms + at.translation[:, :, None], None
        self.packed.columns[:, :3] = moved if self.padded is None else np.where(self.padded, -FAR, moved)
        if self.normals is not None and self.packed.column_normals is not None:
            normals = at.rotation @ self.normals
            shown = normals if self.padded is None else np.where(self.padded, LONG_NORMAL, normals)
            self.packed.column_normals[:, :3] = shown
        self.packed.constants[:, COOL] = 1 / temperature
        return arms, normals

    def _add(self, sums: Sums, totals: Totals) -> None:
        totals.P[:] += sums.rows[:, ROW_OUT : ROW_OUT + 3]
        totals.P_normals[:] += sums.rows[:, ROW_OUT + 3 : ROW_OUT + HEAT]
        totals.P_weights[:] += sums.row_shares[:, 1]
        totals.Q_weights[:] += sums.column_shares[:, 1]
        totals.rounding[:] += self.rounding * sums.rows[:, ROW_OUT + ROUND].sum(axis=1)

    def _unpadded(self, vectors: np.ndarray) -> np.ndarray:
        """Float64, and 0 where padded."""
        return vectors.astype(np.float64) if self.padded is None else np.where(self.padded, 0.0, vectors)
