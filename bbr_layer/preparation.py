"""What a registration needs beside the clouds, and the user did not give: point spacing, normals, a start."""

import logging

from bbr_layer.geometry import RigidMotion
from bbr_layer.normals import estimate_normals
from bbr_layer.pair import CloudPair, Frame, into_frame
from bbr_layer.spacing import with_spacing
from bbr_layer.start import better_start

LOGGER = logging.getLogger("bbr_layer")


def prepared(given: CloudPair, needs_normals: bool, scaled: bool) -> tuple[Frame, CloudPair]:
    """The pair centred (and ``scaled``), with its spacing and, where a loss needs them, its normals."""
    frame, pair = into_frame(given, scaled)
    if needs_normals and (pair.P_normals is None or pair.Q_normals is None):
        LOGGER.info("normals were not given and are estimated from the clouds themselves")
        if pair.P_normals is None:
            pair = pair._replace(P_normals=estimate_normals(pair.P, mask=pair.P_mask))
        if pair.Q_normals is None:
            pair = pair._replace(Q_normals=estimate_normals(pair.Q, mask=pair.Q_mask))
    return frame, with_spacing(pair)


def begun_at(start: RigidMotion | None, pair: CloudPair, frame: Frame, scaled: bool) -> RigidMotion:
    """The start that was given; else the identity for the paper's parametrisation, or the better of two guesses."""
    if start is not None:
        return start
    if not scaled:
        return RigidMotion.identity(pair.P.shape[-1], pair.P.shape[:1], device=pair.P.device)
    return better_start(pair, frame)
