"""The registration terms by name: one class each, one line in the table."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bbr_layer import BBRLayer, RigidMotion
from models.buddy_term import BuddyTerm
from models.chamfer_terms import Chamfer, GemanMcClureChamfer, TrimmedChamfer
from models.residual_term import RegistrationResidual
from models.scan_batch import RegistrationTerm, ScanBatch


@dataclass(frozen=True)
class TermSettings:
    """Settings of the registration terms; each term reads its own.

    Parameters
    ----------
    loss: of ``"buddy"``: ``"softBBS"``, ``"softBD"``, ``"N"`` or ``"F"``. Default softBD.
    keep: of ``"trimmed_chamfer"``: share of the points, nearest first, that count. Default 0.7.
    start: of ``"buddy"`` and ``"geman_mcclure_chamfer"``: first temperature or kernel, in multiples of the
        misalignment. None: the term's own.
    end: the last one, in multiples of the point spacing. None: the term's own.
    """

    loss: str = "softBD"
    keep: float = 0.7
    start: float | None = None
    end: float | None = None


class NoTerm(RegistrationTerm):
    """No registration: the occupancy map alone."""

    def forward(
        self,
        world_points: Float[Tensor, "g n d"],
        world_normals: Float[Tensor, "g n d"] | None,
        mask: Bool[Tensor, "g n"],
        world_from_scan: RigidMotion,
        batch: ScanBatch,
    ) -> Float[Tensor, ""]:
        return world_points.new_zeros((), dtype=torch.float64)


REGISTRATION_TERMS: dict[str, Callable[[TermSettings, BBRLayer | None], RegistrationTerm]] = {
    "none": lambda settings, layer: NoTerm(),
    "chamfer": lambda settings, layer: Chamfer(),
    "trimmed_chamfer": lambda settings, layer: TrimmedChamfer(settings.keep),
    "geman_mcclure_chamfer": lambda settings, layer: GemanMcClureChamfer(start=settings.start, end=settings.end),
    "buddy": lambda settings, layer: BuddyTerm(settings.loss, start=settings.start, end=settings.end),
    "residual": lambda settings, layer: RegistrationResidual(BBRLayer() if layer is None else layer),
}


def registration_term(
    name: str, settings: TermSettings | None = None, layer: BBRLayer | None = None
) -> RegistrationTerm:
    """The registration term called ``name``.

    Parameters
    ----------
    name: one of ``REGISTRATION_TERMS``.
    settings: None: every term's defaults.
    layer: registers edges without a measurement, for ``"residual"``; None: ``BBRLayer()``.

    Raises
    ------
    ValueError: an unknown name, or a setting the term refuses.
    """
    if name not in REGISTRATION_TERMS:
        raise ValueError(f"name is {name!r}; a registration term is one of {', '.join(REGISTRATION_TERMS)}")
    return REGISTRATION_TERMS[name](settings or TermSettings(), layer)
