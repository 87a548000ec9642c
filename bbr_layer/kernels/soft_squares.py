"""The normal equations of a loss over soft buddies: every pair pulls, as much as it is a buddy."""

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from bbr_layer.distances import normal_signs
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.scene import SoftTerms
from bbr_layer.kernels.squares import Equations, cross, or_one, plane_rows, point_rows
from bbr_layer.pair import CloudPair


@runtime_checkable
class SoftMatching(Protocol):
    """How a soft loss sees a pair whose source has been moved."""

    def distances(self, pair: CloudPair) -> Tensor: ...

    def buddies(self, pair: CloudPair, distances: Tensor, temperature: Tensor) -> Tensor: ...


class SoftSquares:
    """Pairs weighted by their soft buddies: softBBS by B, softBD and N, whose distances are not squared, by B / D.

    On points this is weighted Procrustes to second order in the turn of a step; no singular value decomposition is
    taken, which has no derivative where two singular values meet. A step holds some tensors of n x m numbers (N: of
    n x m x 2 d).

    Parameters
    ----------
    loss: knows distances and buddies.
    terms: which loss it is.
    """

    def __init__(self, loss: SoftMatching, terms: SoftTerms):
        self.loss, self.terms = loss, terms

    def hold(self, motion: RigidMotion) -> tuple[Tensor, ...]:
        """Nothing: soft buddies are differentiable."""
        return ()

    def equations(
        self, pair: CloudPair, motion: RigidMotion, temperature: Tensor, held: tuple[Tensor, ...]
    ) -> Equations:
        """See ``Squares``."""
        moved = pair.moved_by(motion)
        distances = self.loss.distances(moved)
        pull = self.loss.buddies(moved, distances, temperature)
        if self.terms.mean:
            pull = pull / or_one(distances)
        arms = motion.rotate(pair.Q.double())
        return self._on_planes(moved, arms, pull) if self.terms.planes else _on_points(moved, arms, pull)

    def _on_planes(self, moved: CloudPair, arms: Tensor, pull: Tensor) -> Equations:
        P_normals, turned = moved.both_normals()
        sign = normal_signs(P_normals, turned)[..., None] if self.terms.align_signs else 1.0
        offsets = (moved.Q[:, None] - moved.P[:, :, None]).double()
        planes = (turned[:, None] + sign * P_normals[:, :, None]).double()
        rows = plane_rows(
            arms[:, None].expand_as(offsets), turned.double()[:, None].expand_as(offsets), offsets, planes
        )
        pulled = (rows * pull[..., None]).flatten(1, 2)
        residual = (offsets * planes).sum(-1).flatten(1)
        return Equations(pulled.mT @ rows.flatten(1, 2), (pulled * residual[..., None]).sum(1))


def _on_points(moved: CloudPair, arms: Tensor, pull: Tensor) -> Equations:
    weights = pull.sum(1, dtype=torch.float64)
    force = weights[..., None] * moved.Q.double() - pull.double().mT @ moved.P.double()
    rows = point_rows(arms)
    matrix = ((rows * weights[..., None, None]).mT @ rows).sum(1)
    return Equations(matrix, torch.cat((cross(arms, force), force), -1).sum(1))
