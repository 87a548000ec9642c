"""The normals of a cloud, differentiable in its coordinates."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bbr_layer.neighbourhoods import nearest_neighbours

# Neighbours (the point itself included) of the plane fit when normals are not given. Measured: 8 of the sparse
# cloud's own points beat 13 (the paper's number, meant for the full cloud) on the bunny at 500 to 1000 points.
NORMAL_NEIGHBOURS = 8
# Two eigenvalues closer than this share of the largest leave the normal undetermined: its gradient is then 0.
EIGENVALUE_GAP = 1e-6


def estimate_normals(
    points: Float[Tensor, "*batch n d"],
    neighbours: int = NORMAL_NEIGHBOURS,
    mask: Bool[Tensor, "*batch n"] | None = None,
) -> Float[Tensor, "*batch n d"]:
    """Unit normals ``(*batch, n, d)``: the direction in which each neighbourhood is thinnest.

    Normals point away from the cloud's centroid, so that they turn with the cloud and two clouds of one object agree.
    Differentiable in the points to first order by perturbation of the eigenvector; where two directions are equally
    thin (lines in 3D, single points) the normal is arbitrary and its gradient 0.

    Parameters
    ----------
    points: ``(*batch, n, d)``, d = 2 or 3.
    neighbours: how many points each plane or line is fitted to, the point itself included. Default 8.
    mask: ``(*batch, n)``, True where a point is real.

    Raises
    ------
    ValueError: fewer than d neighbours asked for.

    >>> grid = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0))
    >>> plane = torch.cat((grid, torch.zeros(16, 1)), dim=1)
    >>> estimate_normals(plane)[0].abs()
    tensor([0., 0., 1.])
    """
    batch, (n, d) = points.shape[:-2], points.shape[-2:]
    if neighbours < d:
        raise ValueError(f"neighbours is {neighbours}; a normal in {d}D needs at least {d}: try {NORMAL_NEIGHBOURS}")
    flat = points if len(batch) == 1 else points.reshape(-1, n, d)
    real = None if mask is None else mask.reshape(-1, n)
    index = nearest_neighbours(flat, neighbours, real)
    around = torch.take_along_dim(flat[:, None], index[..., None], dim=2).double()
    offsets = around - around.mean(2, keepdim=True)
    normals = _thinnest_direction(offsets.mT @ offsets / neighbours)
    outward = _outward(normals, flat.double(), real)
    return (normals * outward).to(points.dtype).reshape(*batch, n, d)


def _thinnest_direction(covariance: Tensor) -> Tensor:
    """Eigenvector of the smallest eigenvalue, with its first-order dependence on the covariance.

    ``n + sum_k v_k <v_k, C n> / (l_0 - l_k)``: the sum is 0 in value, and its derivative is that of the eigenvector.
    ``torch.linalg.eigh`` would also divide by the gap between the *other* two eigenvalues, which may vanish.
    """
    values, vectors = torch.linalg.eigh(covariance.detach())
    normal = vectors[..., 0]
    gaps = values[..., :1] - values[..., 1:]
    determined = -gaps > EIGENVALUE_GAP * values[..., -1:].clamp(min=torch.finfo(values.dtype).tiny)
    inverse_gaps = torch.where(determined, 1 / torch.where(determined, gaps, 1.0), 0.0)
    others = vectors[..., 1:]
    coupling = (others * (covariance @ normal[..., None])).sum(-2)
    correction = (others * (coupling * inverse_gaps)[..., None, :]).sum(-1)
    return normal + correction - correction.detach()


def _outward(normals: Tensor, points: Tensor, mask: Tensor | None) -> Tensor:
    """+1 or -1 per normal: the side away from the centroid of the real points."""
    real = torch.ones_like(points[..., :1]) if mask is None else mask[..., None].to(points.dtype)
    centre = (points * real).sum(-2, keepdim=True) / real.sum(-2, keepdim=True).clamp(min=1.0)
    side = ((points - centre) * normals).detach().sum(-1, keepdim=True)
    return torch.where(side < 0, -1.0, 1.0).to(points.dtype)
