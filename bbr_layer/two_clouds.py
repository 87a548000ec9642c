"""Two whole clouds registered: thinned for the soft stage, refined on more points, judged."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from bbr_layer.backward import Detached
from bbr_layer.clouds import Cloud
from bbr_layer.geometry import RigidMotion
from bbr_layer.layer import BBRLayer
from bbr_layer.normals import estimate_normals
from bbr_layer.registration import Registration
from bbr_layer.verdict import Verdict, give_verdict

DEFAULT_LOSS = "default"
# Points of each cloud in the soft stages, whose cost grows with the square: 0.1 deg on real scans.
SOFT_POINTS = 1000
# Points of each cloud for F, whose cost grows with the number: on a street 0.01 deg, ten times less than with 1000.
FINE_POINTS = 10_000
# Neighbours of the plane fit when normals are not in the files: the paper's number for clouds of many points.
FINE_NEIGHBOURS = 13


class TwoClouds(NamedTuple):
    """A registration of two files' clouds; ``registration`` and ``verdict`` are of the thinned ones."""

    registration: Registration
    verdict: Verdict
    target_from_source: Float[np.ndarray, "d1 d1"]
    target_points: int
    source_points: int


class _Sample(NamedTuple):
    points: torch.Tensor
    normals: torch.Tensor


def register_clouds(
    target: Cloud,
    source: Cloud,
    *,
    loss: str = DEFAULT_LOSS,
    start: Float[np.ndarray, "d1 d1"] | None = None,
    starts: int = 1,
    soft_points: int = SOFT_POINTS,
    seed: int = 0,
) -> TwoClouds:
    """Find the motion that carries ``source`` onto ``target``, and say how far to trust it.

    Parameters
    ----------
    target, source: clouds of one dimension, see ``common_dimension``.
    loss: "softBBS", "softBD", "N" or "F" alone; "default": soft buddies, then F, then F on more points.
    start: ``(d + 1, d + 1)`` target_from_source to begin with; None: in place or centroid on centroid.
    starts: how many starting rotations the first stage tries, see ``BBRLayer``.
    soft_points: how many points of each cloud the soft stages see, drawn at random.
    seed: of that draw.

    Raises
    ------
    ValueError: settings or clouds that cannot be registered, or an answer that is not finite.
    """
    if soft_points < 2:
        raise ValueError(f"points is {soft_points}; a registration needs at least 2 of each cloud: try {SOFT_POINTS}")
    d = target.points.shape[1]
    for name, cloud in (("target", target), ("source", source)):
        if len(cloud.points) <= d:
            raise ValueError(f"the {name} has {len(cloud.points)} points; in {d}D at least {d + 1} are needed")
    motion = None if start is None else RigidMotion.from_matrix(torch.as_tensor(start, dtype=torch.float64))
    draw = np.random.default_rng(seed)
    if loss == DEFAULT_LOSS:
        P, Q = (_sample(cloud, soft_points, draw) for cloud in (target, source))
        motion = _run(BBRLayer(backward=Detached(), starts=starts), P, Q, motion).target_from_source
        last = BBRLayer("F", backward=Detached())
    else:
        last = BBRLayer(loss, backward=Detached(), starts=starts)
    count = max(FINE_POINTS, soft_points) if loss in (DEFAULT_LOSS, "F") else soft_points
    P, Q = (_sample(cloud, count, draw) for cloud in (target, source))
    result = _run(last, P, Q, motion)
    if not np.isfinite(result.target_from_source.matrix.numpy()).all():
        raise ValueError(str(result.words))
    moved = result.target_from_source(Q.points).numpy()
    verdict = give_verdict(P.points.numpy(), moved, float(result.confidence), str(result.words))
    return TwoClouds(result, verdict, result.target_from_source.matrix.numpy(), len(P.points), len(Q.points))


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


def _sample(cloud: Cloud, count: int, draw: np.random.Generator) -> _Sample:
    chosen = np.sort(draw.permutation(len(cloud.points))[:count])
    points = torch.from_numpy(cloud.points[chosen])
    if cloud.normals is not None:
        return _Sample(points, torch.from_numpy(cloud.normals[chosen]))
    return _Sample(points, estimate_normals(points, min(FINE_NEIGHBOURS, len(points))))


def _run(layer: BBRLayer, P: _Sample, Q: _Sample, start: RigidMotion | None) -> Registration:
    return layer(P.points, Q.points, P_normals=P.normals, Q_normals=Q.normals, start=start)
