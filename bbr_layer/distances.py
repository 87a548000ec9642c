"""Distances between the points of two clouds: all pairs, and matched pairs.

Squared distances are sums of explicit coordinate differences. The cheaper ``|p|^2 + |q|^2 - 2 p q`` loses the small
distances that decide who is whose best buddy; through an unrolled registration the loss of digits grows to tens of
percent of the gradient.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer.pair import CloudPair


def smooth_root(squared: Tensor, floor: Tensor | float = 0.0) -> Tensor:
    """``sqrt(squared + floor^2)``, with the derivative defined as 0 where the root itself is 0.

    Parameters
    ----------
    squared: any shape, not negative.
    floor: length below which the root is rounded off, broadcastable; 0 keeps the plain root.
    """
    total = squared + torch.as_tensor(floor, dtype=squared.dtype, device=squared.device).square()
    positive = total > 0
    return torch.where(positive, torch.where(positive, total, 1.0).sqrt(), 0.0)


def flattened(distance: Tensor, temperature: Tensor, reach: float) -> Tensor:
    """``distance / (1 + distance / (reach * temperature))``: as it is where it is small, and never over the product.

    What Geman and McClure do to squares, done to lengths. An infinite ``reach`` changes nothing.
    """
    return distance / (1 + distance / (reach * temperature)) if math.isfinite(reach) else distance


def squared_distances(P: Float[Tensor, "*batch n c"], Q: Float[Tensor, "*batch m c"]) -> Float[Tensor, "*batch n m"]:
    """``sum_k (P[i, k] - Q[j, k])^2`` for every pair, ``(*batch, n, m)``."""
    columns = zip(P.unbind(-1), Q.unbind(-1), strict=True)
    p, q = next(columns)
    total = (p[..., :, None] - q[..., None, :]).square()
    for p, q in columns:
        total = total + (p[..., :, None] - q[..., None, :]).square()
    return total


def point_to_point(pair: CloudPair, smoothing: Tensor | float = 0.0) -> Float[Tensor, "batch n m"]:
    """Euclidean distance of every pair, ``(batch, n, m)``, rounded off below ``smoothing`` (a length)."""
    return smooth_root(squared_distances(pair.P, pair.Q), smoothing)


def symmetric_point_to_plane(
    pair: CloudPair, smoothing: Tensor | float = 0.0, align_signs: bool = True
) -> Float[Tensor, "batch n m"]:
    """Eq. 7 for every pair: ``|<q - p, n_q + n_p>|``, ``(batch, n, m)``, after Rusinkiewicz (2019).

    Parameters
    ----------
    pair: with normals on both clouds.
    smoothing: length below which the absolute value is rounded off.
    align_signs: turn ``n_p`` by the sign of ``<n_p, n_q>`` first. Estimated normals have no side of their own, and
        two of opposite sides would cancel; the printed equation has no such sign.
    """
    normals = pair.both_normals()
    sign = normal_signs(*normals) if align_signs else 1.0
    return smooth_root(plane_residuals((pair.P, pair.Q), normals, sign).square(), smoothing)


def plane_residuals(
    points: tuple[Tensor, Tensor], normals: tuple[Tensor, Tensor], sign: Tensor | float
) -> Float[Tensor, "batch n m"]:
    """``<q - p, n_q + sign n_p>`` for every pair, ``(batch, n, m)``: Eq. 7 before its absolute value."""
    residual = torch.zeros((), dtype=points[0].dtype, device=points[0].device)
    columns = (x.unbind(-1) for x in (*points, *normals))
    for p, q, p_normal, q_normal in zip(*columns, strict=True):
        offset = q[:, None, :] - p[:, :, None]
        residual = residual + offset * (q_normal[:, None, :] + sign * p_normal[:, :, None])
    return residual


def normal_signs(P_normals: Tensor, Q_normals: Tensor) -> Tensor:
    """Sign of ``<n_p, n_q>`` for every pair, +1 where they are orthogonal; piecewise constant, so no gradient."""
    inner = P_normals.detach() @ Q_normals.detach().mT
    return torch.where(inner < 0, -1.0, 1.0).to(inner.dtype)


def matched_plane_normals(
    P_normals: Float[Tensor, "batch m d"], Q_normals: Float[Tensor, "batch m d"]
) -> Float[Tensor, "batch m d"]:
    """``n_q + n_p`` of matched pairs with ``n_p`` turned to the side of ``n_q``, ``(batch, m, d)``."""
    inner = (P_normals * Q_normals).detach().sum(-1, keepdim=True)
    return Q_normals + torch.where(inner < 0, -1.0, 1.0).to(inner.dtype) * P_normals
