"""A cloud turned within its own ellipsoid: where else a volume would be that fits anywhere.

In space the turn is about the middle principal axis, to which the fewest bodies are symmetric: one of revolution has
its own at an end of the three.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.pair import CloudPair

# Least over largest extent with which a cloud is turned: a plane's is 0.
FLATTEST = 0.01


@torch.no_grad()
def half_turned(pair: CloudPair, motion: RigidMotion) -> RigidMotion:
    """The motion after half a turn of the source, which keeps its ellipsoid."""
    centre, _, axes = _principal_axes(pair)
    signs = axes.new_tensor([-1.0, 1.0, -1.0] if motion.dimension == 3 else [-1.0, -1.0])
    turn = (axes * signs) @ axes.mT
    shift = centre - (turn @ centre[..., None])[..., 0]
    return RigidMotion(motion.rotation @ turn, motion.translation + (motion.rotation @ shift[..., None])[..., 0])


@torch.no_grad()
def turned_within(pair: CloudPair, degrees: float) -> CloudPair:
    """The pair with its source stretched to a ball, turned, and stretched back.

    So a volume of any length covers itself again, where a surface does not.
    """
    centre, squares, axes = _principal_axes(pair)
    widest = squares[:, -1].clamp(min=torch.finfo(torch.float64).tiny)
    flatness = (squares[:, 0] / widest).clamp(min=FLATTEST**2).sqrt()
    stretched, of_normals = (axes @ _turn(degrees, ratio, axes) @ axes.mT for ratio in (flatness, 1 / flatness))
    Q = ((pair.Q.double() - centre[:, None]) @ stretched.mT + centre[:, None]).to(pair.Q.dtype)
    if pair.Q_normals is None:
        return pair._replace(Q=Q)
    normals = torch.nn.functional.normalize(pair.Q_normals.double() @ of_normals.mT, dim=-1)
    return pair._replace(Q=Q, Q_normals=normals.to(pair.Q.dtype))


def _principal_axes(
    pair: CloudPair,
) -> tuple[Float[Tensor, "batch d"], Float[Tensor, "batch d"], Float[Tensor, "batch d d"]]:
    """Mean of the source's points, and about it the summed squares along each axis, least first, and the axes."""
    points = pair.Q.double()
    real = torch.ones_like(points[..., 0]) if pair.Q_mask is None else pair.Q_mask.double()
    centre = (real[..., None] * points).sum(-2) / real.sum(-1, keepdim=True).clamp(min=1.0)
    arms = real[..., None] * (points - centre[:, None])
    return centre, *torch.linalg.eigh(arms.mT @ arms)


def _turn(degrees: float, ratio: Tensor, like: Tensor) -> Tensor:
    """From the first axis to the last, whose extents have this ratio."""
    turn = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device).repeat(len(like), 1, 1)
    sine = math.sin(math.radians(degrees))
    turn[:, 0, 0] = turn[:, -1, -1] = math.cos(math.radians(degrees))
    turn[:, 0, -1], turn[:, -1, 0] = -sine * ratio, sine / ratio
    return turn
