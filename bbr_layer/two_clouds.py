"""Two whole clouds registered and judged."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from bbr_layer.backward import Detached
from bbr_layer.clouds import Cloud
from bbr_layer.geometry import RigidMotion
from bbr_layer.layer import ROBUST_STARTS, BBRLayer
from bbr_layer.named_stages import FAST_SOFT_POINTS, SOFT_POINTS, default_stages, fast_stages, named_stage
from bbr_layer.registration import Registration
from bbr_layer.stage import Stage
from bbr_layer.verdict import Verdict, give_verdict

DEFAULT_LOSS = "default"


class TwoClouds(NamedTuple):
    """A registration of two files' clouds, and what is to be thought of it."""

    registration: Registration
    verdict: Verdict
    target_from_source: Float[np.ndarray, "d1 d1"]


def register_clouds(
    target: Cloud,
    source: Cloud,
    *,
    loss: str = DEFAULT_LOSS,
    preset: str = DEFAULT_LOSS,
    start: Float[np.ndarray, "d1 d1"] | None = None,
    starts: int | None = None,
    soft_points: int = SOFT_POINTS,
) -> TwoClouds:
    """Find the motion that carries ``source`` onto ``target``, and say how far to trust it.

    Parameters
    ----------
    target, source: clouds of one dimension, see ``common_dimension``.
    loss: "softBBS", "softBD", "N" or "F" alone; "default": what the preset has.
    preset: "default", "fast" (``BBRLayer.fast()``) or "robust" (``BBRLayer.robust()``).
    start: ``(d + 1, d + 1)`` target_from_source to begin with; None: in place or centroid on centroid.
    starts: how many starting rotations are tried, see ``BBRLayer``; None: as the preset has it.
    soft_points: how many points of each cloud the soft stages see, spread evenly.

    Raises
    ------
    ValueError: settings or clouds that cannot be registered, or an answer that is not finite.
    """
    d = target.points.shape[1]
    for name, cloud in (("target", target), ("source", source)):
        if len(cloud.points) <= d:
            raise ValueError(f"the {name} has {len(cloud.points)} points; in {d}D at least {d + 1} are needed")
    motion = None if start is None else RigidMotion.from_matrix(torch.as_tensor(start, dtype=torch.float64))
    many = starts if starts is not None else ROBUST_STARTS if preset == "robust" else None
    layer = BBRLayer(*_stages(loss, preset, soft_points), backward=Detached(), starts=many)
    P, Q = (torch.from_numpy(cloud.points) for cloud in (target, source))
    normals = [None if cloud.normals is None else torch.from_numpy(cloud.normals) for cloud in (target, source)]
    result = layer(P, Q, P_normals=normals[0], Q_normals=normals[1], start=motion)
    if not np.isfinite(result.target_from_source.matrix.numpy()).all():
        raise ValueError(str(result.words))
    verdict = give_verdict(result, min(len(P), len(Q)))
    return TwoClouds(result, verdict, result.target_from_source.matrix.numpy())


def _stages(loss: str, preset: str, soft_points: int) -> list[Stage]:
    if loss == DEFAULT_LOSS:
        return fast_stages(min(soft_points, FAST_SOFT_POINTS)) if preset == "fast" else default_stages(soft_points)
    if preset != DEFAULT_LOSS:
        raise ValueError(f"loss is {loss} and preset is {preset}; a preset has its own losses: give one of the two")
    return [named_stage(loss, points=None if loss == "F" else soft_points)]


def common_dimension(target: Cloud, source: Cloud) -> tuple[Cloud, Cloud]:
    """The two clouds in 2D if each has two columns or z = 0 throughout, else as they are.

    Raises
    ------
    ValueError: one is 2D and the other is not.
    """
    flat = [cloud.points.shape[1] == 2 or not cloud.points[:, 2].any() for cloud in (target, source)]
    if all(flat):
        return _flattened(target), _flattened(source)
    if target.points.shape[1] != source.points.shape[1]:
        raise ValueError("one cloud is 2D and the other 3D: give both three columns, or both two")
    return target, source


def _flattened(cloud: Cloud) -> Cloud:
    normals = None if cloud.normals is None else cloud.normals[:, :2]
    if normals is not None and not np.allclose(np.linalg.norm(normals, axis=1), 1.0):
        normals = None
    return Cloud(cloud.points[:, :2], normals, cloud.intensity, cloud.dropped)
