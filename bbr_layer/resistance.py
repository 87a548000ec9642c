"""How much of the pairs' hold on each direction of motion is shape, and not the noise of normals."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bbr_layer.distances import matched_plane_normals
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.squares import point_rows
from bbr_layer.matches import Matches, along_normals, summed
from bbr_layer.normals import NORMAL_NEIGHBOURS, estimate_normals
from bbr_layer.pair import CloudPair

# Pairs agree where the median cosine between their normals reaches this (18 degrees); else normals are fitted to
# twice as many points, for noise wider than the spacing. Chosen: 500 points of the bunny have 0.97, of noise 0.6.
AGREEMENT = 0.95
# Share of a cloud's points that a plane may be fitted to.
LARGEST_PATCH = 1 / 8
# Pairs whose middle variance is below this share of the largest, and whose normals never agree, are a line in space:
# a tenth as wide as long. Below the second one they are a line whatever the normals, but for rounding.
LINE_SHARE = 1e-2
EXACT_LINE_SHARE = 1e-8


@torch.no_grad()
def resistance(pair: CloudPair, motion: RigidMotion, found: Matches, scale: Tensor) -> Float[Tensor, "batch k k"]:
    """What the two surfaces together hold, at most; like ``Registration.information``, in the data's unit.

    Along the normals a and b of a pair, ``((a + b) / 2)^2 = a b + ((a - b) / 2)^2``: the sum of the first term keeps
    what both surfaces agree on, the noise of two independent normals cancels in it. Its standard error, from the second
    and from how many patches of points there are, is added: a direction is only called free where that is sure.

    Parameters
    ----------
    pair, found: with normals.
    scale: ``(batch,)`` of the frame.
    """
    arms = motion.rotate(pair.Q.double()) * scale[:, None, None]
    neighbours, largest = NORMAL_NEIGHBOURS, LARGEST_PATCH * torch.minimum(*pair.real_counts())
    held, agreed = _agreed_hold(arms, found, neighbours)
    while (open_items := ~agreed & (2 * neighbours <= largest)).any():
        neighbours *= 2
        found = _with_normals(pair, motion, found, neighbours)
        coarser, settled = _agreed_hold(arms, found, neighbours)
        held, agreed = torch.where(open_items[:, None, None], coarser, held), agreed | (open_items & settled)
    if pair.Q.shape[-1] == 3:
        axis, line = _line(arms, found.mutual, agreed)
        held = torch.where(line[:, None, None], _line_hold(arms, axis, found.mutual), held)
    return held


def _agreed_hold(arms: Tensor, found: Matches, neighbours: int) -> tuple[Tensor, Bool[Tensor, "batch"]]:
    """The hold of each item's pairs, and whether their normals agree."""
    mean, half = found.normal_parts()
    weights = found.mutual.double()
    information, disagreement = (summed(weights, along_normals(arms, part)) for part in (mean, half))
    error = (neighbours / weights.sum(-1).clamp(min=1.0)).sqrt()[:, None, None]
    cosines = mean.square().sum(-1) - half.square().sum(-1)
    median = torch.where(found.mutual, cosines, torch.nan).nanmedian(-1).values
    return information - disagreement + error * disagreement, torch.nan_to_num(median, nan=1.0) >= AGREEMENT


def _with_normals(pair: CloudPair, motion: RigidMotion, found: Matches, neighbours: int) -> Matches:
    """The same pairs with normals of more points."""
    P_normals = estimate_normals(pair.P, neighbours, pair.P_mask).double()
    normals = motion.rotate(estimate_normals(pair.Q, neighbours, pair.Q_mask).double())
    partners = P_normals.gather(1, found.nearest[..., None].expand_as(normals))
    return found._replace(normals=normals, partner_normals=matched_plane_normals(partners, normals) - normals)


def _line(arms: Tensor, mutual: Tensor, agreed: Tensor) -> tuple[Tensor, Bool[Tensor, "batch"]]:
    """Direction in which the pairs extend most, ``(batch, 3)``, and whether in no other."""
    weights = mutual.double()[..., None]
    centre = (weights * arms).sum(1, keepdim=True) / weights.sum(1, keepdim=True).clamp(min=1.0)
    offsets = torch.nan_to_num((arms - centre) * weights)
    values, vectors = torch.linalg.eigh(offsets.mT @ offsets)
    thinness = values[:, 1] / values[:, 2].clamp(min=torch.finfo(values.dtype).tiny)
    return vectors[..., 2], (thinness <= EXACT_LINE_SHARE) | ((thinness <= LINE_SHARE) & ~agreed)


def _line_hold(arms: Tensor, axis: Tensor, mutual: Tensor) -> Tensor:
    """Points of a line hold both directions across it, and no turn about it."""
    on_axis = (arms @ axis[..., None]) * axis[:, None, :]
    across = torch.eye(3, dtype=arms.dtype, device=arms.device) - axis[..., :, None] * axis[..., None, :]
    jacobian = across[:, None] @ point_rows(on_axis)
    return torch.einsum("bn,bndk,bndl->bkl", mutual.double(), jacobian, jacobian)
