"""The two clouds being compared, with everything known about their points, and the frame they are computed in."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.rotations import apply_rotation


class CloudPair(NamedTuple):
    """Target ``P`` and source ``Q`` with their optional companions, one batch dimension.

    Parameters
    ----------
    P, Q: ``(batch, n, d)`` and ``(batch, m, d)`` coordinates.
    P_normals, Q_normals: unit normals of the same shapes.
    P_features, Q_features: ``(batch, n, c)`` and ``(batch, m, c)``, in units of their own.
    P_weights, Q_weights: ``(batch, n)`` and ``(batch, m)``, not negative; a pair counts ``P_weights * Q_weights``.
    P_mask, Q_mask: ``(batch, n)`` and ``(batch, m)``, True where a point is real.
    spacing: ``(batch,)`` typical distance between neighbouring points, the length that smoothing and
        temperatures are multiples of.
    """

    P: Float[Tensor, "batch n d"]
    Q: Float[Tensor, "batch m d"]
    P_normals: Float[Tensor, "batch n d"] | None = None
    Q_normals: Float[Tensor, "batch m d"] | None = None
    P_features: Float[Tensor, "batch n c"] | None = None
    Q_features: Float[Tensor, "batch m c"] | None = None
    P_weights: Float[Tensor, "batch n"] | None = None
    Q_weights: Float[Tensor, "batch m"] | None = None
    P_mask: Bool[Tensor, "batch n"] | None = None
    Q_mask: Bool[Tensor, "batch m"] | None = None
    spacing: Float[Tensor, "batch"] | None = None

    def moved_by(self, motion: RigidMotion) -> "CloudPair":
        """The pair with the source, and its normals, carried by ``motion``."""
        normals = None if self.Q_normals is None else motion.rotate(self.Q_normals)
        return self._replace(Q=motion(self.Q), Q_normals=normals)

    def detach(self) -> "CloudPair":
        """The same numbers, cut from the graph."""
        return CloudPair._make(None if field is None else field.detach() for field in self)

    def known_spacing(self) -> Tensor:
        """The spacing ``(batch,)``.

        Raises
        ------
        ValueError: it is missing.
        """
        if self.spacing is None:
            raise ValueError("pair.spacing is None; smoothing counts in point spacings: give it, or smoothing=0")
        return self.spacing

    def both_normals(self) -> tuple[Tensor, Tensor]:
        """The normals of P and of Q.

        Raises
        ------
        ValueError: one of them is missing.
        """
        if self.P_normals is None or self.Q_normals is None:
            missing = "P_normals" if self.P_normals is None else "Q_normals"
            raise ValueError(f"{missing} is missing; point-to-plane distances need both: try estimate_normals")
        return self.P_normals, self.Q_normals

    def both_features(self) -> tuple[Tensor, Tensor]:
        """The features of P and of Q.

        Raises
        ------
        ValueError: one of them is missing.
        """
        if self.P_features is None or self.Q_features is None:
            missing = "P_features" if self.P_features is None else "Q_features"
            raise ValueError(f"{missing} is missing; matching by features needs both: or match='points'")
        return self.P_features, self.Q_features

    def real_counts(self) -> tuple[Tensor, Tensor]:
        """How many points of P and of Q are real, ``(batch,)`` each."""
        counts = []
        for points, mask in ((self.P, self.P_mask), (self.Q, self.Q_mask)):
            every = torch.full(points.shape[:1], points.shape[1], device=points.device)
            counts.append(every if mask is None else mask.sum(-1))
        return counts[0], counts[1]

    def pair_mask(self) -> Tensor | None:
        """True where both points are real, broadcast to ``(batch, n, m)``; None when every point is."""
        if self.P_mask is None and self.Q_mask is None:
            return None
        rows = self.P.new_ones(self.P.shape[:2], dtype=torch.bool) if self.P_mask is None else self.P_mask
        columns = self.Q.new_ones(self.Q.shape[:2], dtype=torch.bool) if self.Q_mask is None else self.Q_mask
        return rows[:, :, None] & columns[:, None, :]


class Frame(NamedTuple):
    """Where the inner registration computes: each cloud about its own centre, in units of ``scale``.

    Centring in float64 before anything else is what keeps float32 clouds far from the origin exact; the scale is
    what lets one learning rate serve radians and lengths. The user's parametrisation does not change.

    Parameters
    ----------
    target_centre, source_centre: ``(batch, d)`` float64, in the data's unit.
    scale: ``(batch,)`` float64, the mean of the two clouds' root-mean-square radii, or 1.
    """

    target_centre: Tensor
    source_centre: Tensor
    scale: Tensor

    def enter(self, motion: RigidMotion) -> RigidMotion:
        """A motion between the user's frames as a motion between the centred and scaled clouds."""
        carried = apply_rotation(motion.rotation, self.source_centre) + motion.translation
        return RigidMotion(motion.rotation, (carried - self.target_centre) / self.scale[:, None])

    def leave(self, motion: RigidMotion) -> RigidMotion:
        """The inverse of ``enter``."""
        carried = apply_rotation(motion.rotation, self.source_centre)
        translation = self.scale[:, None] * motion.translation + self.target_centre - carried
        return RigidMotion(motion.rotation, translation)


def centre_and_radius(points: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Centroid ``(batch, d)`` and root-mean-square radius ``(batch,)`` in float64; 0 where no point is real."""
    points = points.double()
    real = points.new_ones(points.shape[:-1]) if mask is None else mask.double()
    count = real.sum(-1).clamp(min=1.0)
    centre = (points * real[..., None]).sum(-2) / count[..., None]
    squared = ((points - centre[..., None, :]).square().sum(-1) * real).sum(-1) / count
    positive = squared > 0  # the root's derivative at one repeated point is defined as 0
    return centre, torch.where(positive, torch.where(positive, squared, 1.0).sqrt(), 0.0)


def into_frame(pair: CloudPair, scaled: bool) -> tuple[Frame, CloudPair]:
    """Centre each cloud on its centroid, and scale both by their mean radius if ``scaled``.

    Padded points are put on the centre, so that whatever they held, NaN included, reaches nothing.
    """
    P, Q = _zeroed(pair.P, pair.P_mask), _zeroed(pair.Q, pair.Q_mask)
    target_centre, target_radius = centre_and_radius(P, pair.P_mask)
    source_centre, source_radius = centre_and_radius(Q, pair.Q_mask)
    radius = (target_radius + source_radius) / 2
    usable = (radius > 0) if scaled else torch.zeros_like(radius, dtype=torch.bool)
    frame = Frame(target_centre, source_centre, torch.where(usable, radius, 1.0))
    return frame, pair._replace(
        P=_zeroed(_centred(P, frame.target_centre, frame.scale), pair.P_mask),
        Q=_zeroed(_centred(Q, frame.source_centre, frame.scale), pair.Q_mask),
        P_normals=_zero_padding(pair.P_normals, pair.P_mask),
        Q_normals=_zero_padding(pair.Q_normals, pair.Q_mask),
        P_features=_zero_padding(pair.P_features, pair.P_mask),
        Q_features=_zero_padding(pair.Q_features, pair.Q_mask),
        P_weights=_zero_padding(pair.P_weights, pair.P_mask),
        Q_weights=_zero_padding(pair.Q_weights, pair.Q_mask),
    )


def _centred(points: Tensor, centre: Tensor, scale: Tensor) -> Tensor:
    return ((points.double() - centre[:, None, :]) / scale[:, None, None]).to(points.dtype)


def _zero_padding(values: Tensor | None, mask: Tensor | None) -> Tensor | None:
    return None if values is None else _zeroed(values, mask)


def _zeroed(values: Tensor, mask: Tensor | None) -> Tensor:
    if mask is None:
        return values
    mask = mask if values.ndim == mask.ndim else mask[..., None]
    return torch.where(mask, values, torch.zeros_like(values))
