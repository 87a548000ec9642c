"""The normals of a cloud, differentiable in its coordinates."""

import importlib.util

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bbr_layer.arrays import numpy_too
from bbr_layer.neighbourhoods import nearest_neighbours
from bbr_layer.once import only_once
from bbr_layer.threads import side_by_side

COMPILED = importlib.util.find_spec("numba") is not None
# Neighbours (the point itself included) of the plane fit when normals are not given. Measured: 8 of the sparse
# cloud's own points beat 13 (the paper's number, meant for the full cloud) on the bunny at 500 to 1000 points.
NORMAL_NEIGHBOURS = 8
# Two eigenvalues closer than this share of the largest leave the normal undetermined: its gradient is then 0.
EIGENVALUE_GAP = 1e-6
# Points whose planes one thread fits at once: some milliseconds of work.
ROWS_AT_ONCE = 4096


@numpy_too
def estimate_normals(
    points: Float[Tensor, "*batch n d"],
    neighbours: int = NORMAL_NEIGHBOURS,
    mask: Bool[Tensor, "*batch n"] | None = None,
) -> Float[Tensor, "*batch n d"]:
    """Unit normals ``(*batch, n, d)``: the direction in which each neighbourhood is thinnest.

    Normals point away from the cloud's centroid, so that they turn with the cloud and two clouds of one object agree.
    Differentiable in the points, once, by perturbation of the eigenvector; where two directions are equally thin (lines
    in 3D, single points) the normal is arbitrary and its gradient 0. Of whole numbers the normals are float64.

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
    if not points.is_floating_point():
        points = points.double()
    if not n:
        return points
    flat = points if len(batch) == 1 else points.reshape(-1, n, d)
    real = None if mask is None else mask.reshape(-1, n)
    index = nearest_neighbours(flat, neighbours, real)
    variances, axes = _axes(flat, index)
    normals = axes[..., 0]
    if torch.is_grad_enabled() and flat.requires_grad:
        normals = normals + only_once(_first_order(_covariance(flat, index), variances, axes), flat)
    outward = _outward(normals, flat.double(), real)
    return (normals * outward).to(points.dtype).reshape(*batch, n, d)


def _covariance(points: Tensor, index: Tensor) -> Tensor:
    """Of the points in every row of ``index (batch, n, k)``, ``(batch, n, d, d)`` float64."""
    around = torch.take_along_dim(points[:, None], index[..., None], dim=2).double()
    offsets = around - around.mean(2, keepdim=True)
    return offsets.mT @ offsets / index.shape[-1]


@torch.no_grad()
def _axes(points: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Variances ``(batch, n, d)``, least first, and axes ``(batch, n, d, d)``, by column; compiled where it can be."""
    if points.shape[-1] != 3 or points.device.type != "cpu" or not COMPILED or not len(points):
        return torch.linalg.eigh(_covariance(points, index))
    from bbr_layer.kernels import cpu_axes  # only where it is used: Numba takes long to load

    clouds, rows = points.detach().double().numpy(), index.numpy()
    batch, n = points.shape[:2]
    variances, axes = np.empty((batch, n, 3)), np.empty((batch, n, 3, 3))
    per_cloud = -(-n // ROWS_AT_ONCE)

    def work(number: int) -> None:
        b, part = divmod(number, per_cloud)
        some = slice(ROWS_AT_ONCE * part, ROWS_AT_ONCE * (part + 1))
        cpu_axes.axes(clouds[b], rows[b, some], variances[b, some], axes[b, some])

    side_by_side(work, batch * per_cloud)
    return torch.from_numpy(variances), torch.from_numpy(axes)


def _first_order(covariance: Tensor, variances: Tensor, axes: Tensor) -> Tensor:
    """What depends on the covariance in its first axis, to first order: 0 in value.

    ``sum_k v_k <v_k, C n> / (l_0 - l_k)``. The derivative of ``torch.linalg.eigh`` would also divide by the gap between
    the *other* two eigenvalues, which may vanish.
    """
    normal, others = axes[..., 0], axes[..., 1:]
    gaps = variances[..., :1] - variances[..., 1:]
    determined = -gaps > EIGENVALUE_GAP * variances[..., -1:].clamp(min=torch.finfo(variances.dtype).tiny)
    inverse_gaps = torch.where(determined, 1 / torch.where(determined, gaps, 1.0), 0.0)
    coupling = (others * (covariance @ normal[..., None])).sum(-2)
    correction = (others * (coupling * inverse_gaps)[..., None, :]).sum(-1)
    return correction - correction.detach()


def _outward(normals: Tensor, points: Tensor, mask: Tensor | None) -> Tensor:
    """+1 or -1 per normal: the side away from the centroid of the real points."""
    real = torch.ones_like(points[..., :1]) if mask is None else mask[..., None].to(points.dtype)
    centre = (points * real).sum(-2, keepdim=True) / real.sum(-2, keepdim=True).clamp(min=1.0)
    side = ((points - centre) * normals).detach().sum(-1, keepdim=True)
    return torch.where(side < 0, -1.0, 1.0).to(points.dtype)
