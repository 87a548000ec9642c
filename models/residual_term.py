"""The layer's own answers as the registration term: each edge is pulled to where the layer puts it."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bbr_layer import BBRLayer, RigidMotion
from models.edge_clouds import edge_spacing, relative_poses
from models.scan_batch import RegistrationTerm, ScanBatch, edge_mean

# Below this multiple of the point spacing a residual counts squared, above it linearly: about what one
# registration can be trusted to, and a wrong edge pulls no harder the more it is wrong.
ROUNDING = 0.1


class EdgeAnswer(NamedTuple):
    """What the layer says of each edge.

    Parameters
    ----------
    target_from_source: ``(e, ...)``.
    information: ``(e, k, k)``, rotation vector before translation, about the moved source centroid; None:
        unknown.
    trust: ``(e,)`` in [0, 1].
    """

    target_from_source: RigidMotion
    information: Float[Tensor, "e k k"] | None
    trust: Float[Tensor, "e"]


class RegistrationResidual(RegistrationTerm):
    """How far each edge's relative pose lies from the layer's registration of its two scans, as a length.

    ``sqrt(r^T H r)``, rounded off near 0, with r = (rotation vector, translation) of the difference about the
    moved source centroid and H the information scaled to a mean translation weight of 1: the root mean square
    displacement of the source's points, in the directions the registration can see. Without an information
    every direction counts. The answer is the batch's ``edge_measurement``; without one the layer registers
    the edge now, from the present poses, and the share of mutual buddies says how far to trust it. Answers
    carry no gradient.

    Parameters
    ----------
    layer: registers edges that come without a measurement.
    rounding: in point spacings. Default 0.1.

    Raises
    ------
    ValueError: a rounding that is not positive.
    """

    def __init__(self, layer: BBRLayer, rounding: float = ROUNDING):
        super().__init__()
        if not rounding > 0:
            raise ValueError(
                f"rounding is {rounding}; it counts in point spacings and must be positive: try {ROUNDING}"
            )
        self.layer, self.rounding = layer, rounding

    def forward(
        self,
        world_points: Float[Tensor, "g n d"],
        world_normals: Float[Tensor, "g n d"] | None,
        mask: Bool[Tensor, "g n"],
        world_from_scan: RigidMotion,
        batch: ScanBatch,
    ) -> Float[Tensor, ""]:
        target, source = batch.edges.unbind(1)
        relative = relative_poses(world_from_scan, batch)
        if not len(batch.edges):
            return relative.translation.sum()  # of nothing: 0, with a graph
        answer = self._answer(relative, mask, batch)
        points = torch.where(mask[..., None], batch.points.detach(), 0.0)[source].double()
        # Turned as the answer turns them, and about their centroid: what the information speaks of.
        turned = answer.target_from_source.rotate(points)
        centroid, spread = _moments(turned, mask[source])
        moved = centroid + answer.target_from_source.translation
        residual = pose_residual(relative, answer.target_from_source, moved)
        information, informed = _unit_information(answer.information, spread)
        squared = torch.einsum("ea,eab,eb->e", residual, information, residual).clamp(min=0)
        rounding = self.rounding * edge_spacing(batch)
        length = (squared + rounding.square()).sqrt() - rounding
        usable = informed & mask[target].any(1) & mask[source].any(1)
        return edge_mean(length, torch.where(usable, batch.edge_weight * answer.trust, 0.0))

    def _answer(self, relative: RigidMotion, mask: Tensor, batch: ScanBatch) -> EdgeAnswer:
        if batch.edge_measurement is None:
            return registered_edges(self.layer, relative, mask, batch)
        measurement = batch.edge_measurement.detach().to(relative.translation.dtype)
        return EdgeAnswer(measurement, batch.edge_information, torch.ones_like(batch.edge_weight))


def registered_edges(layer: BBRLayer, relative: RigidMotion, mask: Bool[Tensor, "g n"], batch: ScanBatch) -> EdgeAnswer:
    """Register every edge of the batch from ``relative`` (``target_from_source``), without gradient.

    Trust is the share of the smaller scan's points that have a mutual buddy; 0 where the answer is not
    finite.
    """
    target, source = batch.edges.unbind(1)
    points = torch.where(mask[..., None], batch.points, 0.0).detach()
    normals = None if batch.normals is None else torch.where(mask[..., None], batch.normals, 0.0).detach()
    with torch.no_grad():
        result = layer(
            points[target],
            points[source],
            P_normals=None if normals is None else normals[target],
            Q_normals=None if normals is None else normals[source],
            P_mask=mask[target],
            Q_mask=mask[source],
            start=relative.detach(),
        )
    possible = torch.minimum(mask[target].sum(1), mask[source].sum(1)).clamp(min=1)
    found, information = result.target_from_source, result.information.double()
    finite = found.matrix.isfinite().all((-1, -2)) & information.isfinite().all((-1, -2))
    motion = RigidMotion(
        torch.where(finite[:, None, None], found.rotation, relative.rotation.detach()).double(),
        torch.where(finite[:, None], found.translation, relative.translation.detach()).double(),
    )
    trust = torch.where(finite, result.buddies.double() / possible, 0.0).clamp(max=1.0)
    return EdgeAnswer(motion, torch.where(finite[:, None, None], information, 0.0), trust)


def pose_residual(relative: RigidMotion, answer: RigidMotion, about: Float[Tensor, "e d"]) -> Float[Tensor, "e k"]:
    """Rotation vector w and translation v that carry ``answer`` to ``relative``, turning about ``about``.

    ``relative(x) = exp(w) (answer(x) - about) + about + v`` for every x; ``(e, d (d + 1) / 2)``.
    """
    turn = relative.rotation @ answer.rotation.mT
    offset = relative.translation - answer.translation
    lever = (about - answer.translation)[..., None]
    translation = offset + ((turn - torch.eye(turn.shape[-1], dtype=turn.dtype, device=turn.device)) @ lever)[..., 0]
    return torch.cat((RigidMotion(turn, translation).rotvec, translation), -1)


def _moments(
    points: Float[Tensor, "e n d"], mask: Bool[Tensor, "e n"]
) -> tuple[Float[Tensor, "e d"], Float[Tensor, "e d d"]]:
    """Centroid and covariance of the real points of each item; 0 where none is."""
    count = mask.sum(1).clamp(min=1).to(points.dtype)
    centroid = points.sum(1) / count[:, None]
    offsets = torch.where(mask[..., None], points - centroid[:, None], 0.0)
    return centroid, offsets.mT @ offsets / count[:, None, None]


def _unit_information(
    information: Tensor | None, spread: Float[Tensor, "e d d"]
) -> tuple[Float[Tensor, "e k k"], Bool[Tensor, "e"]]:
    """Information scaled to a mean translation weight of 1, and whether there was any.

    Without one: that of matched points, ``|w x p + v|^2`` averaged over the cloud, from its covariance.
    """
    d = spread.shape[-1]
    if information is None:
        trace = spread.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None]
        eye = torch.eye(d, dtype=spread.dtype, device=spread.device)
        inertia = trace if d == 2 else trace * eye - spread
        blocks = torch.zeros(len(spread), d * (d + 1) // 2, d * (d + 1) // 2, dtype=spread.dtype, device=spread.device)
        blocks[:, :-d, :-d], blocks[:, -d:, -d:] = inertia, eye
        return blocks, torch.ones(len(spread), dtype=torch.bool, device=spread.device)
    information = information.detach().to(spread.dtype)
    weight = information[:, -d:, -d:].diagonal(dim1=-2, dim2=-1).mean(-1)
    informed = weight.isfinite() & (weight > 0)
    scaled = information / torch.where(informed, weight, 1.0)[:, None, None]
    return torch.where(informed[:, None, None], scaled, 0.0), informed
