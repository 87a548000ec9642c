"""The mutual nearest pairs of an answer, and the information that they hold about it."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bbr_layer.distances import matched_plane_normals
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.squares import point_rows
from bbr_layer.pair import CloudPair, Frame
from bbr_layer.searches import search_of


class Matches(NamedTuple):
    """The source carried to the final pose, and its partners.

    Parameters
    ----------
    offsets: ``(batch, m, d)`` from each one's nearest target point to it, float64, in the frame's units.
    normals, partner_normals: ``(batch, m, d)`` of both, the partner's turned to the same side; None without normals.
    nearest: ``(batch, m)`` which target point is the nearest.
    mutual: ``(batch, m)`` whether the two are each other's nearest.
    """

    offsets: Float[Tensor, "batch m d"]
    normals: Float[Tensor, "batch m d"] | None
    partner_normals: Float[Tensor, "batch m d"] | None
    nearest: Int[Tensor, "batch m"]
    mutual: Bool[Tensor, "batch m"]

    def normal_parts(self) -> tuple[Tensor, Tensor]:
        """Half the sum and half the difference of the pairs' normals.

        Raises
        ------
        ValueError: there are none.
        """
        if self.normals is None or self.partner_normals is None:
            raise ValueError("the pairs have no normals: give the clouds theirs, try estimate_normals")
        return (self.normals + self.partner_normals) / 2, (self.normals - self.partner_normals) / 2


@torch.no_grad()
def matched(pair: CloudPair, motion: RigidMotion) -> Matches:
    """Who is whose nearest once the centred source is moved."""
    index, mutual = search_of(pair)(motion)
    rows = index[..., None].expand_as(pair.Q)
    offsets = motion(pair.Q.double()) - pair.P.gather(1, rows).double()
    if pair.P_normals is None or pair.Q_normals is None:
        return Matches(offsets, None, None, index, mutual)
    normals = motion.rotate(pair.Q_normals.double())
    partner_normals = matched_plane_normals(pair.P_normals.gather(1, rows).double(), normals) - normals
    return Matches(offsets, normals, partner_normals, index, mutual)


@torch.no_grad()
def matched_information(
    pair: CloudPair, motion: RigidMotion, frame: Frame, found: Matches
) -> tuple[Float[Tensor, "batch k k"], Float[Tensor, "batch"]]:
    """Gauss-Newton Hessian of the pairs' residuals, and the residuals' root mean square, in the data's unit."""
    scale = frame.scale[:, None, None]
    arms, offsets = motion.rotate(pair.Q.double()) * scale, found.offsets * scale
    weights = found.mutual * pair_weights(pair, found)
    if found.normals is None:
        jacobian = point_rows(arms)
        information = torch.einsum("bn,bndk,bndl->bkl", weights, jacobian, jacobian)
        squared = offsets.square().sum(-1)
    else:
        normals, _ = found.normal_parts()
        information = summed(weights, along_normals(arms, normals))
        squared = (offsets * normals).sum(-1).square()
    total = weights.sum(-1)
    present = total > 0
    mean = torch.where(found.mutual, weights * squared, 0.0).sum(-1) / torch.where(present, total, 1.0)
    return information, mean.sqrt()


def pair_weights(pair: CloudPair, found: Matches) -> Float[Tensor, "batch m"]:
    """Product of the weights of each source point and its nearest, float64."""
    weights = torch.ones_like(found.offsets[..., 0])
    if pair.P_weights is not None:
        weights = weights * pair.P_weights.gather(1, found.nearest)
    return weights if pair.Q_weights is None else weights * pair.Q_weights


def summed(weights: Float[Tensor, "batch m"], jacobian: Float[Tensor, "batch m k"]) -> Float[Tensor, "batch k k"]:
    """Weighted sum of ``J^T J`` over the pairs."""
    return torch.einsum("bn,bnk,bnl->bkl", weights, jacobian, jacobian)


def along_normals(arms: Float[Tensor, "batch m d"], normals: Float[Tensor, "batch m d"]) -> Float[Tensor, "batch m k"]:
    """d(residual along the normal) / d(rotation, translation), ``(batch, m, k)``."""
    return (normals[..., None, :] @ point_rows(arms)).squeeze(-2)
