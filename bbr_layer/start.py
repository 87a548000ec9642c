"""Where a registration begins when nobody says: in place, or centroid on centroid, whichever lies better."""

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.neighbours import nearest_points
from bbr_layer.pair import CloudPair, Frame

# Distances beyond a few of these many point spacings count as no match at all when two starts are compared.
COMPARISON_SPACINGS = 4.0
# Points of each cloud looked at: enough to tell two poses apart, few enough for full lidar scans.
COMPARISON_POINTS = 500


def better_start(pair: CloudPair, frame: Frame) -> RigidMotion:
    """Per item the better of the identity and of centroid on centroid, between the user's frames.

    Both choices follow the data when both clouds are moved or scaled together, and differentiate as such.
    """
    d, batch, device = pair.P.shape[-1], pair.P.shape[0], pair.P.device
    in_place = frame.enter(RigidMotion.identity(d, (batch,), device=device))
    centred = RigidMotion.identity(d, (batch,), device=device)
    better = _misfit(pair, centred) < _misfit(pair, in_place)
    translation = torch.where(better[:, None], centred.translation, in_place.translation)
    return frame.leave(RigidMotion(centred.rotation, translation))


@torch.no_grad()
def _misfit(pair: CloudPair, motion: RigidMotion) -> Tensor:
    """Mean Geman-McClure distance from a thinned source to its nearest targets, ``(batch,)`` in [0, 1]."""
    stride = max(1, pair.Q.shape[1] // COMPARISON_POINTS)
    Q, mask = pair.Q[:, ::stride], None if pair.Q_mask is None else pair.Q_mask[:, ::stride]
    moved = motion(Q)
    index = nearest_points(pair.P, moved, pair.P_mask)
    nearest = pair.P.gather(1, index[..., None].expand(-1, -1, pair.P.shape[-1]))
    squared = (moved - nearest).double().square().sum(-1)
    width = (COMPARISON_SPACINGS * pair.known_spacing().double()[:, None]).square()
    share = squared / (squared + width)
    weights = torch.ones_like(share) if mask is None else mask.double()
    return (share * weights).sum(-1) / weights.sum(-1).clamp(min=1.0)
