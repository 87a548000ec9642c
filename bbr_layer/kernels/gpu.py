"""The soft losses on a GPU: what ``kernels.reference`` answers, from three sweeps in Triton over each cloud.

No n x m tensor is ever in memory. Without a GPU, ``TRITON_INTERPRET=1``, set before Triton is imported, runs the same
sweeps in Python.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer.kernels import gpu_pairs as layout
from bbr_layer.kernels.gpu_clouds import REAL, WEIGHT, Cloud, clouds_of, numbers_of, swept
from bbr_layer.kernels.gpu_forces import FORCE_SUMS, HEAT, ROUND, TORQUE, forces
from bbr_layer.kernels.gpu_sweeps import BUDDY_SUMS, DENOMINATORS, buddy_sums, denominators
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms, loss_of_sums
from bbr_layer.pair import CloudPair


class _Sums(NamedTuple):
    """What a gradient, or its rate of change, is made of; P before Q.

    Parameters
    ----------
    shares: ``(batch, n)`` float64 each, what a point adds to the loss per unit of its weight.
    forces: ``(batch, FORCE_SUMS, n)`` float64 each.
    temperature: ``(batch,)`` float64, the derivative by alpha.
    """

    shares: list[Tensor]
    forces: list[Tensor]
    temperature: Tensor


def lacks(terms: SoftTerms, scene: Scene) -> str:
    """What the sweeps here cannot do of what is asked, in words; ``kernels.reference`` can do it."""
    dtype = scene.pair.P.dtype
    if dtype not in (torch.float32, torch.float64):
        return str(dtype)
    if terms.match != "points":
        return "matching by features on a GPU"
    if terms.clip is not None:
        return "clipped distances on a GPU"
    # exp(-D / alpha) may underflow, in float32 beyond 87 temperatures, and buddies are at most its square over that of
    # epsilon: with an epsilon of at least the root of the smallest number, those underflow too, in any formula.
    smallest = torch.finfo(dtype).tiny ** 0.5
    return f"an epsilon of {terms.outlier:g}, below {smallest:.1g}" if terms.outlier < smallest else ""


@torch.no_grad()
def gradient(terms: SoftTerms, scene: Scene) -> tuple[Tensor, Scene]:
    """Loss ``(batch,)`` float64 and gradient in closed form."""
    loss, sums = _sums(terms, scene, None)
    return loss, _as_scene(terms, scene, sums[0])


@torch.no_grad()
def directional(terms: SoftTerms, scene: Scene, direction: Direction) -> tuple[Scene, Scene]:
    """The gradient and its derivative along ``direction``."""
    _, (sums, rates) = _sums(terms, scene, direction)
    return _as_scene(terms, scene, sums), _as_scene(terms, scene, rates)


def _sums(terms: SoftTerms, scene: Scene, direction: Direction | None) -> tuple[Tensor, list[_Sums]]:
    """The loss and, of its gradient, the sums; with a direction their rates of change too."""
    orders = 1 if direction is None else 2
    kind = (layout.PLANES.value if terms.planes else 0) + (0 if direction is None else layout.RATES.value)
    clouds = clouds_of(terms, scene.pair, direction)
    numbers = numbers_of(terms, scene, direction, clouds)
    sums = swept(denominators, clouds, numbers, orders * DENOMINATORS.value, kind)
    for cloud, total in zip(clouds, sums, strict=True):
        _keep_denominators(cloud, total, terms.outlier)
    sums = swept(buddy_sums, clouds, numbers, orders * BUDDY_SUMS.value, kind)
    loss, shares = _loss_and_shares(terms, clouds, numbers, sums)
    sums = swept(forces, clouds, numbers, orders * FORCE_SUMS.value, kind)
    pulls = [list(parts) for parts in zip(*(x.split(FORCE_SUMS.value, 1) for x in sums), strict=True)]
    alpha = scene.temperature
    heat = [pull[0][:, HEAT.value].sum(-1) / alpha.square() for pull in pulls]
    if direction is not None:
        heat[1] = heat[1] - 2 * heat[0] * direction.temperature / alpha
    return loss, [_Sums(*parts) for parts in zip(shares, pulls, heat, strict=True)]


def _keep_denominators(cloud: Cloud, sums: Tensor, outlier: float) -> None:
    """Put the inverse of a denominator, and its relative rate of change, where the next sweeps find them."""
    inverse = 1 / (outlier + sums[:, 0])
    cloud.put(layout.INVERSE.value, inverse * cloud.channel(REAL))
    if sums.shape[1] > 1:
        cloud.put(layout.INVERSE_RATE.value, sums[:, 1] * inverse)


def _loss_and_shares(
    terms: SoftTerms, clouds: tuple[Cloud, Cloud], numbers: Tensor, sums: tuple[Tensor, Tensor]
) -> tuple[Tensor, list[list[Tensor]]]:
    """The loss, and the shares of P and Q, followed by those of their rates of change if the sums have them."""
    weights = [cloud.channel(WEIGHT) for cloud in clouds]
    S, M, *rates = (weights[0][:, None] * sums[0]).sum(-1).unbind(-1)
    loss, by_S, by_M = loss_of_sums(terms, S, M)
    numbers[..., layout.BY_S.value], numbers[..., layout.BY_M.value] = by_S, by_M
    by_sums = torch.stack([by_S, by_M], -1)[..., None]
    shares = [[(by_sums * x[:, :2]).sum(1) for x in sums]]
    if rates:
        # Of -M / S^2 and 1 / S; of softBBS, whose derivative by M is 0, both are 0.
        by_S_rate, by_M_rate = -by_M * (by_M * rates[1] + 2 * by_S * rates[0]), -by_M.square() * rates[0]
        numbers[..., layout.BY_S_RATE.value], numbers[..., layout.BY_M_RATE.value] = by_S_rate, by_M_rate
        by_sums_rate = torch.stack([by_S_rate, by_M_rate], -1)[..., None]
        shares.append([(by_sums * x[:, 2:] + by_sums_rate * x[:, :2]).sum(1) for x in sums])
    for channel, given in zip((layout.SHARE.value, layout.SHARE_RATE.value), shares, strict=False):
        for cloud, weight, share in zip(clouds, weights, given, strict=True):
            cloud.put(channel, weight * share)
    return loss, shares


def _as_scene(terms: SoftTerms, scene: Scene, sums: _Sums) -> Scene:
    """The gradient, or its rate of change, in the precision of the points."""
    pair, fields = scene.pair, {}
    d, dtype = pair.P.shape[-1], pair.P.dtype
    for side, weights, share, pull in zip(
        "PQ", (pair.P_weights, pair.Q_weights), sums.shares, sums.forces, strict=True
    ):
        fields[side] = pull[:, :d].mT.to(dtype)
        if terms.planes:
            fields[f"{side}_normals"] = pull[:, TORQUE.value : TORQUE.value + d].mT.to(dtype)
        if weights is not None:
            fields[f"{side}_weights"] = share.to(dtype)
    rounding = scene.rounding * sums.forces[0][:, ROUND.value].sum(-1)
    return Scene(CloudPair._make(fields.get(name) for name in CloudPair._fields), sums.temperature, rounding)
