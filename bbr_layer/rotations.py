"""Rotations as vectors, Euler angles and matrices, in 2D and 3D, smooth where they are singular.

The conventions are those of ``bbr_layer/geometry.py``.
"""

import torch
from jaxtyping import Float
from torch import Tensor

# Below this squared angle (rad^2) the closed forms of the exponential and the logarithm lose digits to
# cancellation and their Taylor series, cut after the fourth term, are exact to float64 rounding.
SMALL_ANGLE_SQUARED = 1e-3


def rotation_dimensions(d: int) -> int:
    """How many numbers a rotation has: d (d - 1) / 2, so 1 in 2D and 3 in 3D."""
    return d * (d - 1) // 2


def apply_rotation(rotation: Float[Tensor, "... d d"], vector: Float[Tensor, "... d"]) -> Tensor:
    """R x for one vector per batch item, ``(*batch, d)``."""
    return (rotation @ vector[..., None])[..., 0]


def skew(rotvec: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch d d"]:
    """The matrix W with ``W x = w cross x``; in 2D, of the one angle: ``[[0, -w], [w, 0]]``."""
    zero = torch.zeros_like(rotvec[..., 0])
    if rotvec.shape[-1] == 1:
        w = rotvec[..., 0]
        rows = [torch.stack((zero, -w), -1), torch.stack((w, zero), -1)]
    else:
        x, y, z = rotvec.unbind(-1)
        rows = [
            torch.stack((zero, -z, y), -1),
            torch.stack((z, zero, -x), -1),
            torch.stack((-y, x, zero), -1),
        ]
    return torch.stack(rows, -2)


def rotation_from_rotvec(rotvec: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch d d"]:
    """Exponential map (Rodrigues): ``I + sin(a)/a W + (1 - cos a)/a^2 W^2`` with ``a = |w|``.

    Parameters
    ----------
    rotvec: ``(*batch, 3)`` or ``(*batch, 1)`` in 2D, radians. Smooth everywhere, zero included: the two
        factors are evaluated as series in a^2 near zero, so that values and derivatives of any order stay
        finite there.
    """
    generator = skew(rotvec)
    squared = rotvec.square().sum(-1)[..., None, None]
    small = squared < SMALL_ANGLE_SQUARED
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    sine = torch.where(small, 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)), torch.sin(angle) / angle)
    cosine = torch.where(
        small,
        0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)),
        2 * torch.sin(angle / 2).square() / safe,  # (1 - cos a) / a^2 without the cancellation
    )
    eye = torch.eye(generator.shape[-1], dtype=rotvec.dtype, device=rotvec.device)
    return eye + sine * generator + cosine * (generator @ generator)


def rotvec_from_rotation(rotation: Float[Tensor, "*batch d d"]) -> Float[Tensor, "*batch k"]:
    """Logarithm map, ``(*batch, 3)`` or ``(*batch, 1)`` in 2D, angle in [0, pi].

    Through the unit quaternion whose largest component is taken as pivot, so that half turns have their axis.
    The gradient is finite everywhere, the identity included.
    """
    if rotation.shape[-1] == 2:
        return torch.atan2(rotation[..., 1, 0] - rotation[..., 0, 1], _trace(rotation))[..., None]
    quaternion = _unit_quaternion(rotation)
    vector, scalar = quaternion[..., :3], quaternion[..., 3:]
    sign = torch.where(scalar < 0, -1.0, 1.0).to(scalar.dtype)  # the shorter of the two ways round
    vector, scalar = vector * sign, scalar * sign
    squared = vector.square().sum(-1, keepdim=True)
    small = squared < SMALL_ANGLE_SQUARED
    norm = torch.where(small, torch.ones_like(squared), squared).sqrt()
    # 2 asin(s) / s with s = |vector| = sin(angle / 2), as a series near the identity.
    series = 2 * (1 + squared / 6 * (1 + 9 * squared / 20 * (1 + 25 * squared / 42)))
    return vector * torch.where(small, series, 2 * torch.atan2(norm, scalar) / norm)


def _trace(rotation: Tensor) -> Tensor:
    return rotation.diagonal(dim1=-2, dim2=-1).sum(-1)


def _unit_quaternion(rotation: Tensor) -> Tensor:
    """Quaternion (x, y, z, w): the best conditioned row of the 4 x 4 matrix of products 4 q q^T."""
    r = rotation
    x_y, x_z, y_z = (
        r[..., 1, 0] + r[..., 0, 1],
        r[..., 0, 2] + r[..., 2, 0],
        r[..., 2, 1] + r[..., 1, 2],
    )
    x_w, y_w, z_w = (
        r[..., 2, 1] - r[..., 1, 2],
        r[..., 0, 2] - r[..., 2, 0],
        r[..., 1, 0] - r[..., 0, 1],
    )
    xx, yy, zz = r.diagonal(dim1=-2, dim2=-1).unbind(-1)
    rows = torch.stack(
        [
            torch.stack((1 + xx - yy - zz, x_y, x_z, x_w), -1),
            torch.stack((x_y, 1 - xx + yy - zz, y_z, y_w), -1),
            torch.stack((x_z, y_z, 1 - xx - yy + zz, z_w), -1),
            torch.stack((x_w, y_w, z_w, 1 + xx + yy + zz), -1),
        ],
        -2,
    )
    pivot = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = torch.take_along_dim(rows, pivot[..., None, None], dim=-2)[..., 0, :]
    return row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)


def rotation_from_euler(angles: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch d d"]:
    """Rotation from Euler angles as the paper's authors have it: ``R = Rz(c) Ry(b) Rx(a)``.

    Parameters
    ----------
    angles: ``(*batch, 3)`` = (a, b, c) about the fixed x, y and z axes, radians; ``(*batch, 1)`` in 2D.
    """
    if angles.shape[-1] == 1:
        return rotation_from_rotvec(angles)
    (sin_a, sin_b, sin_c), (cos_a, cos_b, cos_c) = angles.sin().unbind(-1), angles.cos().unbind(-1)
    tilted, fallen = sin_b * sin_a, sin_b * cos_a
    rows = [
        torch.stack((cos_c * cos_b, cos_c * tilted - sin_c * cos_a, cos_c * fallen + sin_c * sin_a), -1),
        torch.stack((sin_c * cos_b, sin_c * tilted + cos_c * cos_a, sin_c * fallen - cos_c * sin_a), -1),
        torch.stack((-sin_b, cos_b * sin_a, cos_b * cos_a), -1),
    ]
    return torch.stack(rows, -2)


def euler_from_rotation(rotation: Float[Tensor, "*batch d d"]) -> Float[Tensor, "*batch k"]:
    """The Euler angles (a, b, c) of ``R = Rz(c) Ry(b) Rx(a)``, b in [-pi/2, pi/2], radians.

    At gimbal lock (|b| = pi/2) only a - c or a + c is determined; a = 0 is chosen there, finite in value
    and in gradient.
    """
    if rotation.shape[-1] == 2:
        return rotvec_from_rotation(rotation)
    r = rotation
    sine = -r[..., 2, 0]
    cosine_squared = r[..., 2, 1].square() + r[..., 2, 2].square()
    locked = cosine_squared < torch.finfo(rotation.dtype).eps
    cosine = torch.where(locked, torch.zeros_like(sine), torch.where(locked, 1.0, cosine_squared).sqrt())
    one, zero = torch.ones_like(sine), torch.zeros_like(sine)
    a = torch.atan2(torch.where(locked, zero, r[..., 2, 1]), torch.where(locked, one, r[..., 2, 2]))
    b = torch.atan2(sine, cosine)
    c = torch.atan2(torch.where(locked, -r[..., 0, 1], r[..., 1, 0]), torch.where(locked, r[..., 1, 1], r[..., 0, 0]))
    return torch.stack((a, b, c), -1)
