"""What a registration answers: the motion, and everything that tells whether to trust it."""

from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bbr_layer.distances import matched_plane_normals
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.squares import point_rows
from bbr_layer.pair import CloudPair, Frame
from bbr_layer.rotations import rotation_dimensions
from bbr_layer.searches import search_of

# Degenerate: the weakest direction holds less than this share of the mean information. A plane sliding on a plane has
# 0 up to noise; a room scanned from inside about 0.1.
DEGENERATE_SHARE = 1e-3


class Status(IntEnum):
    """How a registration ended."""

    CONVERGED = 0
    ITERATION_LIMIT = 1
    NO_BUDDIES = 2
    DEGENERATE = 3
    NON_FINITE = 4

    @property
    def words(self) -> str:
        """What happened and what to try next."""
        return _WORDS[self]


_WORDS = {
    Status.CONVERGED: "converged",
    Status.ITERATION_LIMIT: "the pose was still moving at the last step: give it more steps, or a better start",
    Status.NO_BUDDIES: "no two points are mutual nearest neighbours: check masks, overlap and the start",
    Status.DEGENERATE: "at least one direction of motion is not held by the points: do not trust it along that one",
    Status.NON_FINITE: "the pose is not finite: check the scale of the inputs and of the learning rates",
}


class Registration(NamedTuple):
    """The answer of a registration; every field has the batch dimensions of the input.

    Parameters
    ----------
    target_from_source: the motion that carries Q onto P, float64.
    loss: ``(*batch,)`` last stage's loss at the final pose, in its frame's units; differentiable.
    temperature: ``(*batch,)`` final temperature in the data's unit.
    gradient_norm: ``(*batch,)`` of the last step taken.
    iterations: ``(*batch,)`` inner steps done.
    buddies: ``(*batch,)`` how many pairs are mutual nearest neighbours at the final pose.
    information: ``(*batch, k, k)`` with k = d (d + 1) / 2: sum of J^T J over those pairs, for residuals in data units
        (point to plane where there are normals, else point to point) and a tangent of rotation (radians) before
        translation, about the centroid of the moved source, on the target's axes.
    status: ``(*batch,)`` codes of ``Status``.
    """

    target_from_source: RigidMotion
    loss: Float[Tensor, "*batch"]
    temperature: Float[Tensor, "*batch"]
    gradient_norm: Float[Tensor, "*batch"]
    iterations: Int[Tensor, "*batch"]
    buddies: Int[Tensor, "*batch"]
    information: Float[Tensor, "*batch k k"]
    status: Int[Tensor, "*batch"]

    @property
    def words(self) -> str | list[str]:
        """The status in words; a list, in order, for a batch."""
        words = [Status(code).words for code in self.status.reshape(-1).tolist()]
        return words[0] if self.status.ndim == 0 else words

    def reshape(self, batch: tuple[int, ...]) -> "Registration":
        """The same answer under other batch dimensions."""
        motion = RigidMotion(*(x.reshape((*batch, *x.shape[1:])) for x in self.target_from_source))
        return Registration(motion, *(x.reshape((*batch, *x.shape[1:])) for x in self[1:]))


@torch.no_grad()
def matched_information(pair: CloudPair, motion: RigidMotion, frame: Frame) -> tuple[Tensor, Tensor]:
    """How many mutual pairs there are, ``(batch,)``, and their Gauss-Newton Hessian ``(batch, k, k)`` in data units."""
    index, mutual = search_of(pair)(motion)
    arms = motion.rotate(pair.Q.to(motion.rotation.dtype)) * frame.scale[:, None, None]
    weights = mutual.double()
    if pair.P_weights is not None:
        weights = weights * pair.P_weights.gather(1, index)
    if pair.Q_weights is not None:
        weights = weights * pair.Q_weights
    if pair.P_normals is None or pair.Q_normals is None:
        jacobian = point_rows(arms)
    else:
        P_normals = pair.P_normals.gather(1, index[..., None].expand_as(pair.Q)).double()
        planes = matched_plane_normals(P_normals, motion.rotate(pair.Q_normals.double())) / 2
        jacobian = (planes[:, :, None, :] @ point_rows(arms)).squeeze(2)[:, :, None, :]
    weighted = jacobian * weights[..., None, None]
    return mutual.sum(-1), torch.einsum("bnrk,bnrl->bkl", weighted, jacobian)


@torch.no_grad()
def judge(
    motion: RigidMotion, buddies: Tensor, information: Tensor, frame: Frame, settled: Tensor
) -> Int[Tensor, "batch"]:
    """Status code of each item; the worst that applies."""
    k = rotation_dimensions(motion.dimension)
    unit = torch.ones_like(information[..., 0])
    unit[:, :k] = 1 / frame.scale[:, None]  # a rotation counted by how far it moves the cloud's rim
    comparable = torch.nan_to_num(information * unit[:, :, None] * unit[:, None, :])
    eigenvalues = torch.linalg.eigvalsh(comparable)
    weakest, mean = eigenvalues[:, 0], eigenvalues.mean(-1)
    status = torch.where(settled, int(Status.CONVERGED), int(Status.ITERATION_LIMIT))
    status = torch.where(weakest <= DEGENERATE_SHARE * mean, int(Status.DEGENERATE), status)
    status = torch.where(buddies == 0, int(Status.NO_BUDDIES), status)
    finite = torch.isfinite(motion.translation).all(-1) & torch.isfinite(motion.rotation).all(-1).all(-1)
    return torch.where(finite, status, int(Status.NON_FINITE))
