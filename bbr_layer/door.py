"""The door of the layer: everything that comes in is checked once and brought to one batch dimension."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from bbr_layer import checks
from bbr_layer.geometry import RigidMotion
from bbr_layer.pair import CloudPair


def batch_shape(P: Tensor) -> tuple[int, ...]:
    """The leading batch dimensions of a cloud; ``()`` for a single one."""
    return tuple(P.shape[:-2])


@contextmanager
def own_precision(given: CloudPair) -> Iterator[CloudPair]:
    """Autocast turned off, and what networks gave under it in half precision as wide as the widest of the rest."""
    # What is no tensor is refused a little later, in words.
    kind = given.P.device.type if isinstance(given.P, Tensor) and given.P.device.type != "meta" else "cpu"
    widened = _widened(given) if torch.is_autocast_enabled(kind) else given
    with torch.autocast(kind, enabled=False):
        yield widened


def _widened(given: CloudPair) -> CloudPair:
    floating = [x.dtype for x in given if isinstance(x, Tensor) and x.is_floating_point()]
    widest = max(floating, key=lambda kind: torch.finfo(kind).bits, default=torch.float32)
    half = torch.float16, torch.bfloat16
    return CloudPair._make(x.to(widest) if isinstance(x, Tensor) and x.dtype in half else x for x in given)


def checked_pair(given: CloudPair) -> CloudPair:
    """The pair with one batch dimension and at least float32.

    Raises
    ------
    ValueError: one sentence on what is wrong with which argument.
    """
    P, Q = given.P, given.Q
    checks.check_same_kind(given._asdict())
    checks.check_points("P", P, None if given.P_mask is None else _usable(given.P_mask, P, "P_mask"))
    checks.check_points("Q", Q, None if given.Q_mask is None else _usable(given.Q_mask, Q, "Q_mask"))
    checks.check_pair(P, Q)
    for side, points in (("P", P), ("Q", Q)):
        mask = getattr(given, f"{side}_mask")
        checks.check_normals(f"{side}_normals", getattr(given, f"{side}_normals"), points, mask)
        checks.check_weights(f"{side}_weights", getattr(given, f"{side}_weights"), points, mask)
        checks.check_companion(f"{side}_features", getattr(given, f"{side}_features"), points, trailing=True)
    _check_feature_pair(given)
    batch = batch_shape(P)
    return CloudPair._make(_flat(field, len(batch)) for field in given)


def _usable(mask: Tensor, points: Tensor, name: str) -> Tensor:
    checks.check_mask(name, mask, points)
    return mask


def _check_feature_pair(given: CloudPair) -> None:
    P, Q = given.P_features, given.Q_features
    if (P is None) != (Q is None):
        missing = "P_features" if P is None else "Q_features"
        raise ValueError(f"{missing} is missing; features are matched between the clouds: give both or neither")
    if P is not None and Q is not None and P.shape[-1] != Q.shape[-1]:
        raise ValueError(f"P_features has {P.shape[-1]} channels and Q_features {Q.shape[-1]}; they must agree")
    for name, features, mask in (("P_features", P, given.P_mask), ("Q_features", Q, given.Q_mask)):
        if features is not None and not features.shape[-1]:
            raise ValueError(f"{name} has shape {tuple(features.shape)}, no channels: leave it out")
        if features is not None:
            checks.check_finite(name, features, mask)


def checked_start(start: RigidMotion | None, pair: CloudPair, batch: tuple[int, ...]) -> RigidMotion | None:
    """The start with one batch dimension, in float64; one pose serves a whole batch.

    Raises
    ------
    ValueError: a start that is not a motion of the clouds' dimension, batch shape and device, or is not finite.
    """
    if start is None:
        return None
    if not isinstance(start, RigidMotion):
        raise ValueError(f"start is a {type(start).__name__}; expected a RigidMotion: try RigidMotion.from_matrix(...)")
    if not all(isinstance(part, Tensor) for part in start):
        found = ", ".join(type(part).__name__ for part in start)
        raise ValueError(f"start holds ({found}); the layer takes tensors: torch.as_tensor each, or use register")
    d = pair.P.shape[-1]
    if start.rotation.shape[:-2] != start.translation.shape[:-1]:
        shapes = f"{tuple(start.rotation.shape)} and translation {tuple(start.translation.shape)}"
        raise ValueError(f"start has rotation {shapes}; one of each per pose is wanted: expand one")
    if start.translation.shape[-1] != d or start.rotation.shape[-2:] != (d, d):
        raise ValueError(f"start moves {start.translation.shape[-1]}D points and the clouds are {d}D")
    if tuple(start.translation.shape[:-1]) not in ((), batch):
        raise ValueError(
            f"start has batch shape {tuple(start.translation.shape[:-1])}; expected {batch} or a single pose"
        )
    if start.translation.device != pair.P.device:
        raise ValueError(f"start is on {start.translation.device} and P on {pair.P.device}: try start.to(P.device)")
    checks.check_finite("start", start.matrix, None)
    checks.check_rotation("start.rotation", start.rotation)
    rotation = _own(start.rotation).double().expand(*batch, d, d).reshape(-1, d, d)
    return RigidMotion(rotation, _own(start.translation).double().expand(*batch, d).reshape(-1, d))


def _flat(field: Tensor | None, batch_dims: int) -> Tensor | None:
    if field is None:
        return None
    field = _own(field)
    if field.dtype in (torch.float16, torch.bfloat16):
        field = field.float()
    return field.reshape(math.prod(field.shape[:batch_dims]), *field.shape[batch_dims:])


def _own(values: Tensor) -> Tensor:
    """A tensor of inference mode cannot enter a graph; its copy can."""
    return values.clone() if values.is_inference() else values
