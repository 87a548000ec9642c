"""Poses from registered edges: a robust pose graph, its first pose the anchor.

Every edge pulls with the information its registration found, direction by direction, so that a corridor's edge holds
across the corridor and lets slide along it. Outliers lose their weight by graduated Geman-McClure (Yang et al., 2020);
no kind of edge is privileged.
"""

import math
import warnings
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import MatrixRankWarning, spsolve
from torch import Tensor

from bbr_layer import RigidMotion

# Graduation: the kernel starts so wide that nothing is an outlier and narrows by this factor per round.
NARROWING = 1.6
START_WIDTH = 64.0
# The same where the start is taken to be nearly right: edges that lead far from it then hardly bend it at first.
NEAR_WIDTH = 16.0
# Rounds at the final width: each lets the median forget more of the outliers.
SETTLING_ROUNDS = 8
# Final kernel width in medians of the whitened residuals; about 3 standard deviations of a Gaussian.
FINAL_WIDTH = 4.5
# Gauss-Newton steps per round; the last round converges quadratically.
STEPS_PER_ROUND = 3
# Floor on an edge's information, as a share of its mean: a direction is never believed to be wholly free or fixed.
INFORMATION_FLOOR = 1e-4
# Smallest median residual, as a share of the typical edge length: below it every edge agrees with every other.
RESIDUAL_FLOOR = 1e-6


class Edges(NamedTuple):
    """e registered pairs of scans.

    Parameters
    ----------
    target, source: ``(e,)`` scan numbers.
    target_from_source: the measured motions, ``(e, ...)`` float64.
    information: ``(e, k, k)`` per pair of points, rotation before translation, about the carried ``centre``.
    centre: ``(e, d)`` centroid of the source scan, in its own frame.
    score: ``(e,)`` share of mutual pairs, in [0, 1].
    kind: ``(e,)`` 0 consecutive scans, 1 within the window, 2 loop; 3 a given motion, while edges are sought.
    """

    target: Tensor
    source: Tensor
    target_from_source: RigidMotion
    information: Tensor
    centre: Tensor
    score: Tensor
    kind: Tensor

    def kept(self, which: Tensor) -> "Edges":
        """The edges that ``which`` (mask or numbers) selects."""
        rest = (field[which] for field in self[3:])
        return Edges(self.target[which], self.source[which], self.target_from_source.item(which), *rest)

    def joined(self, other: "Edges") -> "Edges":
        """These edges, then ``other``'s."""
        motion = RigidMotion(*map(torch.cat, zip(self.target_from_source, other.target_from_source, strict=True)))
        rest = (torch.cat(pair) for pair in zip(self[3:], other[3:], strict=True))
        return Edges(torch.cat((self.target, other.target)), torch.cat((self.source, other.source)), motion, *rest)


def solve_pose_graph(edges: Edges, start: RigidMotion, *, near: bool = False) -> tuple[RigidMotion, Tensor]:
    """Poses that the edges agree on, and how much each edge was believed, ``(e,)`` in [0, 1].

    Parameters
    ----------
    edges: at least a chain.
    start: ``world_from_scan (k, ...)`` to begin at; the first is kept.
    near: the start is nearly right; edges that it contradicts count little from the first step on.

    Raises
    ------
    ValueError: the edges say nothing of some pose.
    """
    root = _information_root(edges)
    widths = _graduation(NEAR_WIDTH if near else START_WIDTH)
    weights = _weights(edges, start, root, widths[0]) if near else torch.ones(len(edges.target), dtype=torch.float64)
    poses = start
    for width in widths:
        for _ in range(STEPS_PER_ROUND):
            poses = _gauss_newton(edges, poses, root, weights)
        weights = _weights(edges, poses, root, width)
    if not poses.matrix.isfinite().all():
        raise ValueError(
            "no poses follow from the edges, as nothing in common was found for some scans: leave out scans that show "
            "too little, or give starting poses"
        )
    return poses, weights


def disagreement(motion: RigidMotion, edges: Edges) -> Tensor:
    """Turn and displacement of the source's centre from each edge's motion to the one in ``motion``, ``(e, k)``."""
    turn = RigidMotion(motion.rotation @ edges.target_from_source.rotation.mT, motion.translation).rotvec
    shift = (motion(edges.centre[:, None]) - edges.target_from_source(edges.centre[:, None]))[:, 0]
    return torch.cat((turn, shift), -1)


def _graduation(widest: float) -> list[float]:
    """Kernel widths, narrowing to 1 and staying there while the scale of the inliers settles."""
    rounds = math.ceil(math.log(widest) / math.log(NARROWING))
    return [widest / NARROWING**turn for turn in range(rounds)] + [1.0] * SETTLING_ROUNDS


def _weights(edges: Edges, poses: RigidMotion, root: Tensor, width: float) -> Tensor:
    """Geman-McClure's weight of each edge, the kernel ``width`` times its final width.

    Edges between copies of a scan, which stay in place to the last bit, say nothing of how exact the others are.
    """
    sizes = torch.linalg.vector_norm(_residuals(edges, poses, root), dim=-1)
    lengths = torch.linalg.vector_norm(edges.target_from_source.translation, dim=-1)
    moving = lengths > RESIDUAL_FLOOR * lengths.max()
    if not moving.any():
        return torch.ones_like(sizes)
    scale = sizes[moving].median().clamp(min=RESIDUAL_FLOOR * float(lengths[moving].median()))
    return (1 + (sizes / (width * FINAL_WIDTH * scale)).square()).pow(-2)


def _information_root(edges: Edges) -> Tensor:
    """L with ``L L^T`` the floored information, so that ``L^T residual`` is a length in data units."""
    k = edges.information.shape[-1]
    trace = edges.information.diagonal(dim1=-2, dim2=-1).clamp(min=0)
    floor = INFORMATION_FLOOR * trace + torch.finfo(torch.float64).tiny
    return torch.linalg.cholesky(edges.information + torch.diag_embed(floor + 1e-12 * trace.sum(-1, keepdim=True) / k))


def _residuals(edges: Edges, poses: RigidMotion, root: Tensor) -> Tensor:
    """Whitened disagreement of each edge: turn, and displacement of the source's centre, ``(e, k)``."""
    apart = disagreement(poses.between(edges.target, edges.source), edges)
    return (root.mT @ apart[..., None])[..., 0]


def _jacobians(edges: Edges, poses: RigidMotion) -> tuple[Tensor, Tensor]:
    """d residual / d(turn and shift of the target pose, of the source pose) before whitening, ``(e, k, k)`` each."""
    target, source = poses.item(edges.target), poses.item(edges.source)
    arm = source.rotate(edges.centre[:, None])[:, 0]
    reach = arm + source.translation - target.translation
    back = target.rotation.mT
    turned = back if back.shape[-1] == 3 else torch.ones_like(back[:, :1, :1])
    zero = torch.zeros(len(arm), turned.shape[1], back.shape[-1], dtype=torch.float64)

    def assembled(lever: Tensor, sign: float) -> Tensor:
        top = torch.cat((sign * turned, zero), -1)
        return torch.cat((top, torch.cat((sign * back @ lever, sign * back), -1)), -2)

    return assembled(_lever(reach), -1.0), assembled(_lever(arm), 1.0)


def _lever(arm: Tensor) -> Tensor:
    """d(w cross arm) / dw, ``(e, d, 1 or 3)``."""
    if arm.shape[-1] == 2:
        return torch.stack((-arm[:, 1], arm[:, 0]), -1)[..., None]
    axes = torch.eye(3, dtype=arm.dtype).expand(len(arm), 3, 3)
    return torch.linalg.cross(axes, arm[:, None].expand_as(axes), dim=-1).mT


def _gauss_newton(edges: Edges, poses: RigidMotion, root: Tensor, weights: Tensor) -> RigidMotion:
    residual = _residuals(edges, poses, root) * weights.sqrt()[:, None]
    blocks = [(root.mT @ j) * weights.sqrt()[:, None, None] for j in _jacobians(edges, poses)]
    e, k = residual.shape
    scans = poses.translation.shape[0]
    columns = torch.stack((edges.target, edges.source), 1)
    data = torch.stack(blocks, 1).reshape(2 * e, k, k).numpy()
    jacobian = csc_array(
        bsr_array((data, columns.reshape(-1).numpy(), np.arange(0, 2 * e + 1, 2)), shape=(e * k, scans * k))
    )[:, k:]  # the first pose is the anchor
    with warnings.catch_warnings():  # of a singular matrix: the poses are then NaN, and the caller says so
        warnings.simplefilter("ignore", MatrixRankWarning)
        step = spsolve(csc_array(jacobian.T @ jacobian), -jacobian.T @ residual.reshape(-1).numpy())
    moved = torch.cat((torch.zeros(k, dtype=torch.float64), torch.from_numpy(step))).reshape(scans, k)
    turns = k - poses.dimension
    turn = RigidMotion.from_rotvec(moved[:, :turns], moved[:, turns:])
    return RigidMotion(turn.rotation @ poses.rotation, poses.translation + turn.translation)
