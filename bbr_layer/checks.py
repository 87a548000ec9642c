"""Bad input turned into one clear sentence, at the door and nowhere else."""

import torch
from torch import Tensor

# Fewest points that can say anything about a motion; a single one leaves every rotation open.
FEWEST_POINTS = 2
# How far R R^T may be from the identity: files hold 6 digits.
ROTATION_TOLERANCE = 1e-3
# How far the length of a normal may be from 1: those that files hold in a byte per axis are off by a few percent.
UNIT_TOLERANCE = 0.05
FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)


def check_points(name: str, points: Tensor, mask: Tensor | None) -> None:
    """Refuse what is not a cloud ``(*batch, n, d)`` of at least two finite points in 2D or 3D."""
    if points.dtype not in FLOATS:
        raise ValueError(f"{name} has dtype {points.dtype}; coordinates must be floating point: try {name}.float()")
    shape = tuple(points.shape)
    if points.ndim < 2:
        raise ValueError(f"{name} has shape {shape}; expected (*batch, points, 2 or 3): add the missing dimension")
    if points.shape[-1] not in (2, 3):
        hint = f": try {name}.mT" if points.shape[-2] in (2, 3) else ""
        raise ValueError(f"{name} has shape {shape}; its last dimension must hold 2 or 3 coordinates{hint}")
    if points.shape[-2] < FEWEST_POINTS:
        count = "no points" if points.shape[-2] == 0 else "one point"
        raise ValueError(f"{name} has {count} (shape {shape}); a registration needs at least {FEWEST_POINTS} of each")
    check_finite(name, points, mask)


def check_finite(name: str, values: Tensor, mask: Tensor | None) -> None:
    """Refuse NaN and infinity, except where the mask says that nothing is there."""
    wrong = ~torch.isfinite(values)
    if mask is not None:
        wrong = wrong & (mask if wrong.ndim == mask.ndim else mask[..., None])
    if wrong.any():
        raise ValueError(
            f"{name} holds {int(wrong.sum())} values that are NaN or infinite: drop those points, or mask them out"
        )


def check_same_kind(named: dict[str, Tensor | None]) -> None:
    """Refuse what is not a tensor, and tensors of another dtype or device than ``P``."""
    P = named["P"]
    for name, values in named.items():
        if values is None:
            continue
        if not isinstance(values, Tensor) or not isinstance(P, Tensor):
            wrong = name if not isinstance(values, Tensor) else "P"
            raise ValueError(f"{wrong} is a {type(named[wrong]).__name__}; the layer takes tensors: torch.as_tensor")
        if values.device != P.device:
            raise ValueError(f"{name} is on {values.device} and P on {P.device}: move one, {name}.to(P.device)")
        if values.dtype != P.dtype and not (values.dtype == torch.bool and name.endswith("_mask")):
            one, other = (name, "P") if P.is_floating_point() else ("P", name)
            raise ValueError(f"{name} has dtype {values.dtype} and P {P.dtype}: convert one, {one}.to({other}.dtype)")


def check_pair(P: Tensor, Q: Tensor) -> None:
    """Refuse clouds of different dimensions or batch shapes."""
    if P.shape[-1] != Q.shape[-1]:
        raise ValueError(f"P is {P.shape[-1]}D and Q {Q.shape[-1]}D: both clouds must have the same dimension")
    if 0 in P.shape[:-2]:
        raise ValueError(f"P has batch shape {tuple(P.shape[:-2])}; that is no pair at all: leave the call out")
    if P.shape[:-2] != Q.shape[:-2]:
        raise ValueError(
            f"P has batch shape {tuple(P.shape[:-2])} and Q {tuple(Q.shape[:-2])}; they must agree: expand one"
        )


def check_companion(name: str, values: Tensor | None, points: Tensor, *, trailing: bool) -> None:
    """Refuse normals, features (``trailing``) or weights and masks that do not belong to ``points``."""
    if values is None:
        return
    wanted = tuple(points.shape[:-1])
    found = tuple(values.shape[:-1]) if trailing else tuple(values.shape)
    if found != wanted:
        shown = ", ".join(map(str, wanted)) + (", channels" if trailing else "")
        raise ValueError(f"{name} has shape {tuple(values.shape)}; expected ({shown}), one row per point")


def check_normals(name: str, normals: Tensor | None, points: Tensor, mask: Tensor | None) -> None:
    """Refuse normals of another shape, not finite, not of length 1, or zero, as files without normals often hold."""
    check_companion(name, normals, points, trailing=True)
    if normals is None:
        return
    if normals.shape != points.shape:
        raise ValueError(f"{name} has shape {tuple(normals.shape)}; expected {tuple(points.shape)}, one per point")
    check_finite(name, normals, mask)
    lengths = normals.detach().double().norm(dim=-1)
    lengths = lengths if mask is None else torch.where(mask, lengths, 1.0)
    if (lengths == 0).any():
        count = int((lengths == 0).sum())
        raise ValueError(f"{name} holds {count} zero vectors: leave it out and normals are estimated")
    least, most = float(lengths.min()), float(lengths.max())
    if least < 1 - UNIT_TOLERANCE or most > 1 + UNIT_TOLERANCE:
        hint = f"try torch.nn.functional.normalize({name}, dim=-1)"
        raise ValueError(f"{name} has lengths from {least:.3g} to {most:.3g}; normals have length 1: {hint}")


def check_weights(name: str, weights: Tensor | None, points: Tensor, mask: Tensor | None) -> None:
    """Refuse weights that are negative, not finite, or not one per point."""
    check_companion(name, weights, points, trailing=False)
    if weights is None:
        return
    check_finite(name, weights, mask)
    negative = weights < 0
    if mask is not None:
        negative = negative & mask
    if negative.any():
        raise ValueError(f"{name} holds negative weights, as low as {float(weights[negative].min()):g}: use 0 for none")


def check_mask(name: str, mask: Tensor | None, points: Tensor) -> None:
    """Refuse masks that are not boolean or not one per point."""
    if mask is None:
        return
    if mask.dtype != torch.bool:
        raise ValueError(f"{name} has dtype {mask.dtype}; a mask is boolean, True where a point is real: {name}.bool()")
    check_companion(name, mask, points, trailing=False)


def check_rotation(name: str, rotation: Tensor) -> None:
    """Refuse matrices ``(*batch, d, d)`` that are not orthogonal, or that reflect."""
    found = rotation.detach().double()
    apart = (found @ found.mT - torch.eye(found.shape[-1], dtype=found.dtype, device=found.device)).abs().max()
    if apart > ROTATION_TOLERANCE or (torch.linalg.det(found) < 0).any():
        raise ValueError(
            f"{name} is no rotation (R R^T is off the identity by {apart:.1g}, or it reflects): orthogonalise"
        )
