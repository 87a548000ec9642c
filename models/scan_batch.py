"""What the mapper reads, a padded group of scans and the edges between them; and what its exchangeable parts are."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from bbr_layer import RigidMotion, estimate_normals, point_spacing


class ScanBatch(NamedTuple):
    """A group of g scans padded to n points, and e edges between them.

    Parameters
    ----------
    points: ``(g, n, d)`` in each scan's own sensor frame, the sensor at the origin.
    mask: ``(g, n)``, True where a point is real; padded points may hold anything.
    index: ``(g,)`` number of each scan in the whole sequence; scan 0 is the anchor.
    start: ``world_from_scan`` before any correction, ``(g, ...)`` float64.
    edges: ``(e, 2)`` positions within the group: target, source.
    edge_weight: ``(e,)`` how far each edge is trusted, not negative.
    normals: ``(g, n, d)`` unit normals in the sensor frame; estimated by whoever needs them when None.
    edge_measurement: ``target_from_source`` of each edge as registered earlier, ``(e, ...)``; None: unknown.
    edge_information: ``(e, k, k)`` of those registrations, k = d (d + 1) / 2, rotation vector before
        translation, about the moved source centroid; None: unknown.
    spacing: ``(g,)`` median distance between neighbouring points of each scan; measured by whoever needs it
        when None.
    """

    points: Float[Tensor, "g n d"]
    mask: Bool[Tensor, "g n"]
    index: Int[Tensor, "g"]  # type: ignore[assignment]  # hides tuple.index, which nobody asks of a batch
    start: RigidMotion
    edges: Int[Tensor, "e 2"]
    edge_weight: Float[Tensor, "e"]
    normals: Float[Tensor, "g n d"] | None = None
    edge_measurement: RigidMotion | None = None
    edge_information: Float[Tensor, "e k k"] | None = None
    spacing: Float[Tensor, "g"] | None = None

    def without_padding(self) -> "ScanBatch":
        """The batch with zeros in place of whatever padded points and normals hold, NaN included."""
        real = self.mask[..., None]
        normals = None if self.normals is None else torch.where(real, self.normals, 0.0)
        return self._replace(points=torch.where(real, self.points, 0.0), normals=normals)

    def known_spacing(self) -> Float[Tensor, "g"]:
        """The scans' spacing, given or measured, float64, in the data's unit; without gradient."""
        if self.spacing is not None:
            return self.spacing.detach().double()
        return point_spacing(self.without_padding().points.detach(), self.mask)

    def known_normals(self) -> Float[Tensor, "g n d"]:
        """The scans' normals, given or estimated, in the sensor frame; without gradient, 0 where padded."""
        clean = self.without_padding()
        if clean.normals is not None:
            return clean.normals.detach()
        normals = estimate_normals(clean.points.detach(), mask=self.mask)
        return torch.where(self.mask[..., None], normals, 0.0)


class Localisation(nn.Module, ABC):
    """What corrects the poses of scans; its corrections begin at zero."""

    @abstractmethod
    def corrections(self, batch: ScanBatch) -> Float[Tensor, "g k"]:
        """Rotation vector (radians), then translation (in the model's unit) of each scan; k = 3 in 2D, 6 in 3D."""


class RegistrationTerm(nn.Module, ABC):
    """How well neighbouring scans agree: one number in the data's unit of length, to be minimised.

    Every term is the mean over the edges of the batch, weighted by ``edge_weight``; 0 without edges. Being
    lengths, all of them pull with a similar force, and one weight serves any unit.
    """

    def set_progress(self, fraction: float) -> None:
        """Tell the term that ``fraction`` in [0, 1] of the training is done; a term that anneals listens."""

    @abstractmethod
    def forward(
        self,
        world_points: Float[Tensor, "g n d"],
        world_normals: Float[Tensor, "g n d"] | None,
        mask: Bool[Tensor, "g n"],
        world_from_scan: RigidMotion,
        batch: ScanBatch,
    ) -> Float[Tensor, ""]:
        """The term for scans at ``world_from_scan``; normals turned into the world, or None."""


def edge_mean(values: Float[Tensor, "e"], weights: Float[Tensor, "e"]) -> Float[Tensor, ""]:
    """Weighted mean over edges in float64; 0, with derivative 0, where there are none or no weight."""
    weights = weights.double()
    total = weights.sum()
    return (values.double() * weights).sum() / torch.where(total > 0, total, torch.ones_like(total))
