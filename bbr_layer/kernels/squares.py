"""A loss as weighted least squares over buddies that are held: the normal equations of a Gauss-Newton step.

With the buddies, and how much each counts, held at the pose of the moment, every loss of the paper is a sum of
``c_k r_k^2 / 2`` over pairs: the residual r is an offset or its part across a plane, and the weight c makes the sum's
gradient that of the loss (iteratively reweighted least squares; Holland and Welsch, 1977). A step solves
``sum(c J J^T) x = -sum(c r J)`` for the turn and shift x of the pose.
"""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer.distances import flattened, matched_plane_normals, smooth_root
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.likeness import likeness
from bbr_layer.neighbours import MutualNeighbours
from bbr_layer.pair import CloudPair


class Equations(NamedTuple):
    """``matrix x = -slope`` of a step: ``(batch, k, k)`` and ``(batch, k)`` float64, the turn before the shift."""

    matrix: Tensor
    slope: Tensor


@runtime_checkable
class Squares(Protocol):
    """The normal equations of one loss."""

    def hold(self, motion: RigidMotion) -> tuple[Tensor, ...]:
        """What is found at ``motion`` and has no derivative, such as hard buddies."""

    def equations(
        self, pair: CloudPair, motion: RigidMotion, temperature: Tensor, held: tuple[Tensor, ...]
    ) -> Equations:
        """The normal equations at ``motion`` of a ``pair`` whose source is not yet moved; plain torch."""


class MatchedSquares:
    """F's: mutual nearest neighbours on the planes of Eq. 7; the weight of a pair is that of its rounded distance.

    Parameters
    ----------
    search: finds the pairs.
    reach: in temperatures, see ``BuddyFilter``. Default infinite.
    alike: a pair counts as much as its points are alike, see ``BuddyFilter``.
    """

    def __init__(self, search: MutualNeighbours, reach: float = math.inf, alike: bool = False):
        self.search, self.reach, self.alike = search, reach, alike

    def hold(self, motion: RigidMotion) -> tuple[Tensor, ...]:
        """Indices of the nearest target points, and which choices are mutual, ``(batch, m)`` each."""
        return self.search(motion)

    def equations(
        self, pair: CloudPair, motion: RigidMotion, temperature: Tensor, held: tuple[Tensor, ...]
    ) -> Equations:
        """See ``Squares``."""
        index, mutual = held
        P_normals, _ = pair.both_normals()
        moved = pair.moved_by(motion)
        _, turned = moved.both_normals()
        offsets = (moved.Q - gathered(pair.P, index)).double()
        facing = gathered(P_normals, index)
        planes = matched_plane_normals(facing, turned).double()
        residual = (offsets * planes).sum(-1)
        weights = mutual.double()
        if pair.P_weights is not None:
            weights = weights * pair.P_weights.gather(1, index)
        if pair.Q_weights is not None:
            weights = weights * pair.Q_weights
        total = weights.sum(-1, keepdim=True)
        share = torch.where(total > 0, weights / or_one(total), 0.0)  # without any weight there is no loss to follow
        if self.alike:
            share = share * likeness(offsets, (facing.double(), turned.double()), pair.known_spacing().double())
        rounding = temperature.double()[:, None]
        rounded = smooth_root(residual.square(), rounding)
        pull = share * (flattened(rounded, rounding, self.reach) / or_one(rounded)).square() / or_one(rounded)
        rows = plane_rows(motion.rotate(pair.Q.double()), turned.double(), offsets, planes)
        pulled = rows * pull[..., None]
        return Equations(pulled.mT @ rows, (pulled * residual[..., None]).sum(1))


def plane_rows(arms: Tensor, turned: Tensor, offsets: Tensor, planes: Tensor) -> Float[Tensor, "*rows k"]:
    """d(residual of Eq. 7) / d(turn, shift): ``arm x plane + n_q x offset`` and ``plane``; the normal turns too."""
    torque = cross(arms, planes) + cross(turned, offsets)
    return torch.cat((torque, planes.expand(*torque.shape[:-1], planes.shape[-1])), -1)


def point_rows(arms: Tensor) -> Float[Tensor, "*rows d k"]:
    """d(moved point) / d(turn, shift), ``[w x arm, I]``, arms ``(*rows, d)`` from the centre of turning."""
    d = arms.shape[-1]
    shift = torch.eye(d, dtype=arms.dtype, device=arms.device).expand(*arms.shape, d)
    if d == 2:
        turn = torch.stack((-arms[..., 1], arms[..., 0]), -1)[..., None]
    else:
        axes = torch.eye(3, dtype=arms.dtype, device=arms.device).expand(*arms.shape, 3)
        turn = torch.linalg.cross(axes, arms[..., None, :].expand_as(axes), dim=-1).mT
    return torch.cat((turn, shift), dim=-1)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of vectors in space, ``(..., 3)``; in the plane its one number, ``(..., 1)``."""
    if a.shape[-1] == 2:
        return (a[..., :1] * b[..., 1:]) - (a[..., 1:] * b[..., :1])
    return torch.linalg.cross(a, b, dim=-1)


def gathered(values: Tensor, index: Tensor) -> Tensor:
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def or_one(values: Tensor) -> Tensor:
    """The values, and 1 where they are 0 and nothing is divided by them that matters."""
    return torch.where(values > 0, values, 1.0)
