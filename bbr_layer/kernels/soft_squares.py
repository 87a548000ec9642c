"""The normal equations of a loss over soft buddies: every pair pulls, as much as it is a buddy."""

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from bbr_layer.distances import normal_signs, plane_residuals
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
    taken, which has no derivative where two singular values meet. A step holds some tensors of n x m numbers.

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
        """A pair's row is linear in ``u = (1, p, s n_p)``: sums over p of products of u are all it takes of P."""
        normals, pull = moved.both_normals(), pull.double()
        sign = normal_signs(*normals).double() if self.terms.align_signs else torch.ones_like(pull)
        P, Q, P_normals, turned = (x.double() for x in (moved.P, moved.Q, *normals))
        points = torch.cat((torch.ones_like(P[..., :1]), P), -1)
        heavy = pull * plane_residuals((P, Q), (P_normals, turned), sign)
        slopes = torch.cat((heavy.mT @ points, (heavy * sign).mT @ P_normals), -1)
        rows = _rows(arms, turned, Q)
        matrix = rows.mT @ _moments(pull, sign, points, P_normals) @ rows
        return Equations(matrix.sum(1), (rows * slopes[..., None]).sum((1, 2)))


def _moments(pull: Tensor, sign: Tensor, points: Tensor, normals: Tensor) -> Tensor:
    """``sum_i pull_ij u_ij u_ij^T`` with ``u_ij = (points_i, sign_ij normals_i)``, ``(batch, m, 1 + 2 d, 1 + 2 d)``."""
    k, d = points.shape[-1], normals.shape[-1]
    even = torch.cat((_outer(points, points), _outer(normals, normals)), -1)  # a sign times itself is 1
    by_points, by_normals = (pull.mT @ even).split((k * k, d * d), -1)
    mixed = ((pull * sign).mT @ _outer(points, normals)).unflatten(-1, (k, d))
    upper = torch.cat((by_points.unflatten(-1, (k, k)), mixed), -1)
    return torch.cat((upper, torch.cat((mixed.mT, by_normals.unflatten(-1, (d, d))), -1)), -2)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return (a[..., :, None] * b[..., None, :]).flatten(-2)


def _rows(arms: Tensor, turned: Tensor, Q: Tensor) -> Tensor:
    """The rows of a source point's pairs as a linear map of ``(1, p, s n_p)``, ``(batch, m, 1 + 2 d, k)``."""
    eye = torch.eye(Q.shape[-1], dtype=Q.dtype, device=Q.device).expand(*Q.shape, Q.shape[-1])
    none = torch.zeros_like(eye)
    offsets = torch.cat((Q[..., None, :], -eye, none), -2)
    planes = torch.cat((turned[..., None, :], none, eye), -2)
    return plane_rows(arms[..., None, :].expand_as(offsets), turned[..., None, :].expand_as(offsets), offsets, planes)


def _on_points(moved: CloudPair, arms: Tensor, pull: Tensor) -> Equations:
    weights = pull.sum(1, dtype=torch.float64)
    force = weights[..., None] * moved.Q.double() - pull.double().mT @ moved.P.double()
    rows = point_rows(arms)
    matrix = ((rows * weights[..., None, None]).mT @ rows).sum(1)
    return Equations(matrix, torch.cat((cross(arms, force), force), -1).sum(1))
