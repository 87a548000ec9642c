"""F in closed form: everything happens on the mutual pairs, so its sweeps are as long as the source."""

import math

import torch
from torch import Tensor

from bbr_layer.distances import flattened, matched_plane_normals, smooth_root
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.forward_mode import along
from bbr_layer.kernels.scene import Direction, Scene
from bbr_layer.neighbours import MutualNeighbours
from bbr_layer.pair import CloudPair


class MatchedKernel:
    """Mean rounded distance of Eq. 7 over mutual nearest neighbours, found anew at each motion and held in derivatives.

    Parameters
    ----------
    search: finds them.
    reach: in temperatures, see ``BuddyFilter``. Default infinite.
    """

    def __init__(self, search: MutualNeighbours, reach: float = math.inf):
        self.search, self.reach = search, reach

    def gradient(self, scene: Scene, motion: RigidMotion) -> tuple[Tensor, Scene]:
        """Loss ``(batch,)`` and gradient by everything in the scene; see ``Kernel``."""
        index, mutual = self.search(motion)
        loss, gradient = _gradient(_matched(scene.pair, index), scene.temperature, mutual, self.reach)
        return loss, _scattered(gradient, scene.pair, index)

    def directional(self, scene: Scene, motion: RigidMotion, direction: Direction) -> tuple[Scene, Scene]:
        """The gradient, and its derivative along ``direction``."""
        index, mutual = self.search(motion)
        matched = scene._replace(pair=_matched(scene.pair, index))
        found = along(lambda at: _gradient(at.pair, at.temperature, mutual, self.reach)[1], matched, direction)
        return _scattered(found[0], scene.pair, index), _scattered(found[1], scene.pair, index)


def _matched(pair: CloudPair, index: Tensor) -> CloudPair:
    """The pair with every field of P brought into the order of Q: its nearest neighbour in each row."""
    P_normals, _ = pair.both_normals()
    weights = None if pair.P_weights is None else pair.P_weights.gather(1, index)
    return pair._replace(P=_gathered(pair.P, index), P_normals=_gathered(P_normals, index), P_weights=weights)


def _gradient(pair: CloudPair, temperature: Tensor, mutual: Tensor, reach: float) -> tuple[Tensor, Scene]:
    """Loss and gradient of matched rows; those by P's fields still in the order of Q."""
    P_normals, Q_normals = pair.both_normals()
    offsets = pair.Q - pair.P
    planes = matched_plane_normals(P_normals, Q_normals)
    signs = torch.where((P_normals * Q_normals).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(planes.dtype)
    residual = (offsets * planes).sum(-1)
    rounding = temperature.to(residual.dtype)[:, None]
    rounded = smooth_root(residual.square(), rounding)
    distances = flattened(rounded, rounding, reach)
    slope = (distances / torch.where(rounded > 0, rounded, 1.0)).square() if math.isfinite(reach) else 1.0
    P_weights, Q_weights = (1.0 if x is None else x for x in (pair.P_weights, pair.Q_weights))
    real = mutual.to(residual.dtype)
    weights = real * P_weights * Q_weights
    total = weights.sum(-1, dtype=torch.float64)
    inverse = torch.where(total > 0, 1 / torch.where(total > 0, total, 1.0), 0.0)
    loss = (weights * distances).sum(-1, dtype=torch.float64) * inverse
    scaled = weights * inverse.to(residual.dtype)[:, None]
    over = torch.where(rounded > 0, scaled * slope / torch.where(rounded > 0, rounded, 1.0), 0.0)
    force = (over * residual)[..., None]
    excess = (real * (distances - loss.to(residual.dtype)[:, None])) * inverse.to(residual.dtype)[:, None]
    gradient = CloudPair(
        P=-force * planes,
        Q=force * planes,
        P_normals=force * signs * offsets,
        Q_normals=force * offsets,
        P_weights=None if pair.P_weights is None else excess * Q_weights,
        Q_weights=None if pair.Q_weights is None else excess * P_weights,
    )
    by_temperature = temperature * over.sum(-1, dtype=torch.float64)
    if math.isfinite(reach):  # the flattened part of a distance is its share of the reach
        by_temperature = by_temperature + (scaled * reach * (distances / (reach * rounding)).square()).sum(-1).double()
    return loss, Scene(gradient, by_temperature, torch.zeros_like(temperature))


def _gathered(values: Tensor, index: Tensor) -> Tensor:
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))


def _scattered(gradient: Scene, given: CloudPair, index: Tensor) -> Scene:
    """The gradient with the fields of P back in P's own order."""
    fields = {}
    for name in ("P", "P_normals", "P_weights"):
        rows, whole = getattr(gradient.pair, name), getattr(given, name)
        if rows is not None:
            where = index if rows.ndim == 2 else index[..., None].expand_as(rows)
            fields[name] = torch.zeros_like(whole).scatter_add(1, where, rows)
    return gradient._replace(pair=gradient.pair._replace(**fields))
