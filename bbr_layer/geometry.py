"""Rigid motions and rotations in 2D and 3D, with any leading batch dimensions.

The one convention of the package, to which every other module refers:

- ``P`` is the target and stays; ``Q`` is the source and moves (Eq. 1 of the paper: P against R Q + t).
- Points are rows: ``(*batch, n, d)`` with d = 2 or 3. ``D[i, j]`` is the distance from ``P[i]`` to the moved ``Q[j]``.
- A motion is named by its frames: ``target_from_source`` means ``x_target = R x_source + t``.
- Angles are radians (names ending ``_deg`` hold degrees); lengths are in the data's own unit.
- Ragged batches carry a mask, True where a point is real.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer.arrays import numpy_too
from bbr_layer.rotations import apply_rotation, rotation_from_rotvec, rotvec_from_rotation


class RigidMotion(NamedTuple):
    """A rotation and a translation, ``x_target = R x_source + t``, as tensors or numpy arrays.

    Parameters
    ----------
    rotation: ``(*batch, d, d)``, orthogonal with determinant 1.
    translation: ``(*batch, d)``, in the data's unit.
    """

    rotation: Tensor
    translation: Tensor

    @numpy_too
    def __call__(self, points: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n d"]:
        """Carry points ``(*batch, n, d)`` by the motion; the answer has the points' dtype, of integers the motion's."""
        moved = points.to(self.translation.dtype) @ self.rotation.mT + self.translation[..., None, :]
        return moved.to(points.dtype) if points.is_floating_point() else moved

    @numpy_too
    def rotate(self, vectors: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n d"]:
        """Turn vectors (normals, directions) ``(*batch, n, d)`` without translating them; types as for points."""
        turned = vectors.to(self.rotation.dtype) @ self.rotation.mT
        return turned.to(vectors.dtype) if vectors.is_floating_point() else turned

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.translation.shape[-1]

    @property
    @numpy_too
    def matrix(self) -> Tensor:
        """Homogeneous matrix ``(*batch, d + 1, d + 1)``."""
        top = torch.cat((self.rotation, self.translation[..., None]), dim=-1)
        bottom = torch.zeros_like(top[..., :1, :])
        bottom[..., -1] = 1.0
        return torch.cat((top, bottom), dim=-2)

    @property
    @numpy_too
    def rotvec(self) -> Tensor:
        """Rotation vector ``(*batch, 3)`` (or the angle ``(*batch, 1)`` in 2D), radians."""
        return rotvec_from_rotation(self.rotation)

    @numpy_too
    def inverse(self) -> "RigidMotion":
        """The motion that undoes this one."""
        rotation = self.rotation.mT
        return RigidMotion(rotation, -apply_rotation(rotation, self.translation))

    @numpy_too
    def compose(self, inner: "RigidMotion") -> "RigidMotion":
        """This motion after ``inner``: ``a_from_c = a_from_b.compose(b_from_c)``."""
        carried = apply_rotation(self.rotation, inner.translation) + self.translation
        return RigidMotion(self.rotation @ inner.rotation, carried)

    def __matmul__(self, inner: "RigidMotion") -> "RigidMotion":
        return self.compose(inner)

    def item(self, index: int | slice | tuple[int, ...] | Tensor) -> "RigidMotion":
        """Index the batch dimensions (an int, slice, mask or index tensor)."""
        return RigidMotion(self.rotation[index], self.translation[index])

    def between(self, target: int | Tensor, source: int | Tensor) -> "RigidMotion":
        """``target_from_source`` of pairs of these poses, by their numbers; all of them lead to one world."""
        return self.item(target).inverse() @ self.item(source)

    def to(self, target: torch.dtype | torch.device | str) -> "RigidMotion":
        """Another dtype or device."""
        return RigidMotion(self.rotation.to(target), self.translation.to(target))

    def detach(self) -> "RigidMotion":
        """The same motion, cut from the graph."""
        return RigidMotion(self.rotation.detach(), self.translation.detach())

    @staticmethod
    def identity(
        d: int, batch: tuple[int, ...] = (), dtype: torch.dtype = torch.float64, device: torch.device | None = None
    ) -> "RigidMotion":
        """The motion that leaves everything where it is."""
        rotation = torch.eye(d, dtype=dtype, device=device).expand(*batch, d, d).clone()
        return RigidMotion(rotation, torch.zeros(*batch, d, dtype=dtype, device=device))

    @staticmethod
    def from_matrix(matrix: Float[Tensor, "*batch d1 d1"]) -> "RigidMotion":
        """From homogeneous matrices ``(*batch, d + 1, d + 1)``."""
        return RigidMotion(matrix[..., :-1, :-1], matrix[..., :-1, -1])

    @staticmethod
    @numpy_too
    def from_rotvec(rotvec: Float[Tensor, "*batch k"], translation: Float[Tensor, "*batch d"]) -> "RigidMotion":
        """From a rotation vector ``(*batch, 3)`` or an angle ``(*batch, 1)``, radians, and a translation."""
        return RigidMotion(rotation_from_rotvec(rotvec), translation)


@numpy_too
def angular_error(first: Float[Tensor, "... d d"], second: Float[Tensor, "... d d"]) -> Float[Tensor, "..."]:
    """Angle between two rotations, ``(*batch,)`` radians: ``2 asin(||R1 - R2||_F / sqrt 8)``.

    The chordal form keeps its digits for small angles, where the arc cosine of the trace loses half of them.
    The paper leaves its definition to a supplement; this is the form its authors' code evaluates.
    """
    chord = torch.linalg.matrix_norm(first - second)
    scale = 8.0**0.5  # a half turn is 2 sqrt(2) apart in the plane and in space alike
    return 2 * torch.asin((chord / scale).clamp(max=1.0))


@numpy_too
def translation_error(first: Float[Tensor, "... d"], second: Float[Tensor, "... d"]) -> Float[Tensor, "..."]:
    """Distance between two translations, ``(*batch,)``, in the data's unit."""
    return torch.linalg.vector_norm(first - second, dim=-1)
