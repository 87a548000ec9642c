"""The compiled sweeps behind the interface of ``reference.py``: tensors in, tensors out.

Nothing is of size n x m but how far features are apart, where buddies are found by them.
"""

import numpy as np
import torch
from torch import Tensor

from bbr_layer.kernels.cpu_apart import MOST_PAIRS, Features
from bbr_layer.kernels.cpu_batch import DUAL, GRADIENT, Packed, room_for_sums, run_sweeps
from bbr_layer.kernels.cpu_items import Loss, Normals
from bbr_layer.kernels.cpu_math import (
    ALIGN,
    CHANNELS,
    COLUMN_CHANNELS,
    COLUMN_OUT,
    CONSTANTS,
    COOL,
    COOL_RATE,
    HEAT,
    ROUND,
    ROW_OUT,
    SMOOTH,
    SPACE,
    VELOCITY,
    WEIGHT,
)
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms
from bbr_layer.pair import CloudPair

# Where padded points are put, and how long their normals are: so far from everything, along every axis, that nothing
# of them reaches a sum. In float32 their exponential is 1e-35: over the smallest epsilon below, a share that counts as
# 0, and in a denominator, even 1e8 times over as its rate, nothing beside that epsilon.
FAR, LONG_NORMAL = 1e8, 10.0
# The smallest epsilon of Eq. 4 that sums of float32 exponentials can be added to without subtracting a maximum first.
SMALLEST_OUTLIER = 1e-12


def lacks(terms: SoftTerms, scene: Scene) -> str:
    """What the compiled sweeps cannot do of what is asked, in words; empty where they can do it all."""
    pair = scene.pair
    # Distances of features are held for all pairs of an item.
    if terms.match != "points" and pair.P.shape[1] * pair.Q.shape[1] > MOST_PAIRS:
        return f"matching by features between more than {MOST_PAIRS} pairs of points"
    if terms.clip and (pair.P_mask is not None or pair.Q_mask is not None):
        return "clipped distances with padded points"
    if terms.outlier < SMALLEST_OUTLIER:
        return f"an epsilon of {terms.outlier:g}, below {SMALLEST_OUTLIER:g}"
    return ""


def loss_of(terms: SoftTerms) -> Loss:
    """The loss as the sweeps know it."""
    return Loss(terms.outlier, terms.mean, terms.clip or 0.0)


def gradient(terms: SoftTerms, scene: Scene) -> tuple[Tensor, Scene]:
    """As ``reference.soft_gradient``."""
    packed = pack(terms, scene)
    losses = run_sweeps(GRADIENT, packed, loss_of(terms))
    return torch.from_numpy(losses), _with_features(_unpacked(scene, packed, 0), terms, packed)


def directional(terms: SoftTerms, scene: Scene, direction: Direction) -> tuple[Scene, Scene]:
    """As ``reference.soft_directional``."""
    packed = pack(terms, scene, direction)
    run_sweeps(DUAL, packed, loss_of(terms))
    found, rates = _unpacked(scene, packed, 0), _with_features(_unpacked(scene, packed, 1), terms, packed)
    if packed.features is not None:  # the sweeps add up their rates alone
        found = gradient(terms, scene)[1]
    # The derivative by the temperature has alpha^2 below it, which changes too.
    cooling = 2 * found.temperature * direction.temperature / scene.temperature
    return found, rates._replace(temperature=rates.temperature - cooling)


def pack(terms: SoftTerms, scene: Scene, direction: Direction | None = None) -> Packed:
    """A scene, and how it moves, as the sweeps read them."""
    pair = scene.pair
    rows = _side(pair.P, pair.P_weights, pair.P_mask, CHANNELS)
    columns = _side(pair.Q, pair.Q_weights, pair.Q_mask, COLUMN_CHANNELS)
    if direction is not None:
        _put(columns, VELOCITY, direction.Q)
    normals: Normals = None
    if terms.planes:
        P_normals, Q_normals = pair.both_normals()
        normals = _normals(P_normals, pair.P_mask, 3), _normals(Q_normals, pair.Q_mask, 6)
        if terms.clip:
            normals += (np.zeros((len(rows), 1), dtype=rows.dtype),)
        if direction is not None and direction.Q_normals is not None:
            _put(normals[1], 3, direction.Q_normals)
    constants = np.zeros((len(rows), CONSTANTS), dtype=rows.dtype)
    constants[:, SMOOTH] = scene.rounding.detach().numpy() ** 2
    constants[:, COOL] = 1 / scene.temperature.detach().numpy()
    constants[:, ALIGN] = float(terms.align_signs)
    constants[:, SPACE] = float(terms.match == "both")
    if direction is not None:
        constants[:, COOL_RATE] = (direction.temperature / scene.temperature).detach().numpy()
    room = room_for_sums(len(rows), rows.shape[2], columns.shape[2])
    features = None if terms.match == "points" else _features(pair, terms.feature_weight)
    return Packed((rows, columns), normals, features, *room, constants)


def _features(pair: CloudPair, weight: float) -> Features:
    f, g = (weight * x.detach().numpy() for x in pair.both_features())
    padded = [None if mask is None else ~mask.numpy() for mask in (pair.P_mask, pair.Q_mask)]
    room = (np.zeros(x.shape) for x in (f, g))
    return Features(f, np.ascontiguousarray(g.transpose(0, 2, 1)), (padded[0], padded[1]), *room)


def _with_features(found: Scene, terms: SoftTerms, packed: Packed) -> Scene:
    """The same with the derivatives by features, which the sweeps leave aside."""
    if packed.features is None:
        return found
    by_P, by_Q = (terms.feature_weight * torch.from_numpy(x) for x in (packed.features.by_P, packed.features.by_Q))
    dtype = found.pair.P.dtype
    return found._replace(pair=found.pair._replace(P_features=by_P.to(dtype), Q_features=by_Q.to(dtype)))


def _side(points: Tensor, weights: Tensor | None, mask: Tensor | None, channels: int) -> np.ndarray:
    """Channels ``(batch, channels, n)`` of one cloud, the padded points far away and without weight."""
    batch, n, d = points.shape
    side = np.zeros((batch, channels, n), dtype=points.detach().numpy().dtype)
    side[:, :d] = points.detach().numpy().transpose(0, 2, 1)
    side[:, WEIGHT] = 1.0 if weights is None else weights.detach().numpy()
    if mask is not None:
        padded = ~mask.numpy()
        side[:, :3] = np.where(padded[:, None], FAR if channels == CHANNELS else -FAR, side[:, :3])
        side[:, WEIGHT] = np.where(padded, 0.0, side[:, WEIGHT])
    return side


def _normals(normals: Tensor, mask: Tensor | None, channels: int) -> np.ndarray:
    batch, n, d = normals.shape
    side = np.zeros((batch, channels, n), dtype=normals.detach().numpy().dtype)
    side[:, :d] = normals.detach().numpy().transpose(0, 2, 1)
    if mask is not None:
        side[:, :3] = np.where(~mask.numpy()[:, None], LONG_NORMAL, side[:, :3])
    return side


def _put(side: np.ndarray, channel: int, vectors: Tensor) -> None:
    side[:, channel : channel + vectors.shape[-1]] = vectors.detach().numpy().transpose(0, 2, 1)


def _unpacked(scene: Scene, packed: Packed, order: int) -> Scene:
    """The gradient (order 0) or, but for the temperature's own change, its rates (1)."""
    rows, columns = packed.sums[0][:, ROW_OUT * order :], packed.sums[1][:, COLUMN_OUT * order :]
    by_row, by_column = (shares[:, order] for shares in packed.shares)
    pair = scene.pair
    with_normals = pair.P_normals is not None and pair.Q_normals is not None
    fields = CloudPair(
        P=_field(rows, 0, pair.P, pair.P_mask),
        Q=_field(columns, 0, pair.Q, pair.Q_mask),
        P_normals=_field(rows, 3, pair.P, pair.P_mask) if with_normals else None,
        Q_normals=_field(columns, 3, pair.Q, pair.Q_mask) if with_normals else None,
        P_weights=None if pair.P_weights is None else _share(by_row, pair.P_weights, pair.P_mask),
        Q_weights=None if pair.Q_weights is None else _share(by_column, pair.Q_weights, pair.Q_mask),
    )
    heat, rounding = (torch.from_numpy(rows[:, k].sum(-1)) for k in (HEAT, ROUND))
    return Scene(fields, heat / scene.temperature.square(), scene.rounding * rounding)


def _field(table: np.ndarray, first: int, like: Tensor, mask: Tensor | None) -> Tensor:
    """Channels of a table, from ``first``, as vectors of the shape of ``like``; 0 where padded."""
    values = torch.from_numpy(table[:, first : first + like.shape[-1]]).mT.to(like.dtype)
    return values if mask is None else torch.where(mask[..., None], values, 0.0)


def _share(table: np.ndarray, like: Tensor, mask: Tensor | None) -> Tensor:
    values = torch.from_numpy(table).to(like.dtype)
    return values if mask is None else torch.where(mask, values, 0.0)
