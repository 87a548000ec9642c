"""How well two clouds fit under a motion: a number that can be compared between motions."""

import torch
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.pose_gradient import PairKernel
from bbr_layer.losses import SoftBBS
from bbr_layer.matches import matched
from bbr_layer.pair import CloudPair
from bbr_layer.stage import SOFT_SMOOTHING

# A buddy is near within so many point spacings, and lies on its plane within about so many: F begins that rounded. Both
# chosen; what they do is seen in benchmarks/starts.md.
NEAR, ON_PLANE = 2.0, 0.3


def score(pair: CloudPair, motion: RigidMotion) -> Tensor:
    """How well the centred clouds fit, the more the better, ``(batch,)`` float64; comparable between motions."""
    if pair.P_normals is None or pair.Q_normals is None:
        loss = SoftBBS(smoothing=SOFT_SMOOTHING)
        kernel = PairKernel(loss.kernel(pair), pair, loss.smoothing * pair.known_spacing().double())
        return -kernel.slope(motion, loss.temperature_unit(pair).double()).loss
    found, spacing = matched(pair, motion), pair.known_spacing().double()[:, None]
    planes, _ = found.normal_parts()
    near = found.mutual & (torch.linalg.vector_norm(found.offsets, dim=-1) < NEAR * spacing)
    off_plane = (found.offsets * planes).sum(-1) / (ON_PLANE * spacing)
    return torch.where(near, torch.exp(-off_plane.square()), 0.0).sum(-1)
