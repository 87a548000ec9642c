"""Everything that edges are found from: scans as the layer reads them, as trees, as views, as features."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer import RigidMotion
from train.free_space_evidence import RangeView, range_views
from train.prepared import Prepared
from train.scans import ScanSet
from train.shape_features import RADIUS, common_view, shape_features
from train.surfaces import Surface, surfaces

# Points agree within this many spacings along the normal, and this many between them.
OFF_PLANE, BETWEEN = 0.5, 4.0
# How much a share of points that contradict each other weighs against those that agree, as the exponent of a falling
# exponential: corridors agree best without motion, and only a few points say that it is wrong.
CONTRADICTION = 5.0


class Scene(NamedTuple):
    """k scans, thinned: padded for the layer, with trees, and what each saw by direction.

    ``features``: of each scan's points, in space only; empty in the plane. ``middle (k, d)``, ``scatter (k, d, d)``:
    mean and covariance of each scan's points.
    """

    prepared: Prepared
    surfaces: list[Surface]
    views: list[RangeView | None]
    features: list[Float[np.ndarray, "n 33"]]
    middle: Float[Tensor, "k d"]
    scatter: Float[Tensor, "k d d"]

    @property
    def spacing(self) -> float:
        """Median of the scans' point spacings."""
        return float(np.median([scan.spacing for scan in self.surfaces]))


def build_scene(scans: ScanSet, prepared: Prepared) -> Scene:
    """The scans of a sequence with all that is looked up in them."""
    found = surfaces(prepared)
    features: list[np.ndarray] = []
    if scans.dimension == 3:
        radius, view = RADIUS * float(np.median([scan.spacing for scan in found])), common_view(found)
        features = [shape_features(scan, radius, view) for scan in found]
    middle = np.stack([scan.points.mean(axis=0) for scan in found])
    scatter = np.stack([np.cov(scan.points.T, bias=True) for scan in found])
    moments = torch.from_numpy(middle), torch.from_numpy(scatter)
    return Scene(prepared, found, range_views(scans, found), features, *moments)


def scores(scene: Scene, pairs: tuple[Tensor, Tensor], target_from_source: RigidMotion) -> Float[Tensor, " e"]:
    """How well the two scans of each pair agree under its motion, in [0, 1]; comparable within a sequence."""
    motions = target_from_source.matrix.numpy()
    numbers = zip(pairs[0].tolist(), pairs[1].tolist(), strict=True)
    return torch.tensor(
        [_score(scene, pair, motion) for pair, motion in zip(numbers, motions, strict=True)], dtype=torch.float64
    )


def _score(scene: Scene, pair: tuple[int, int], motion: Float[np.ndarray, "d1 d1"]) -> float:
    target, source = (scene.surfaces[number] for number in pair)
    rotation, shift = motion[:-1, :-1], motion[:-1, -1]
    moved, carried_back = source.points @ rotation.T + shift, (target.points - shift) @ rotation
    apart, nearest = target.tree.query(moved)
    mutual = source.tree.query(carried_back)[1][nearest] == np.arange(len(moved))
    normals = source.normals @ rotation.T
    signs = np.where((normals * target.normals[nearest]).sum(axis=1) < 0, -0.5, 0.5)
    planes = target.normals[nearest] / 2 + signs[:, None] * normals
    off = np.abs(((moved - target.points[nearest]) * planes).sum(axis=1))
    spacing = max(target.spacing, source.spacing)
    agree = np.mean(mutual & (apart < BETWEEN * spacing) & (off < OFF_PLANE * spacing))
    agree *= len(moved) / min(len(moved), len(carried_back))
    views: Sequence[tuple[RangeView | None, np.ndarray]] = (
        (scene.views[pair[0]], moved),
        (scene.views[pair[1]], carried_back),
    )
    against = [float(view.saw_through(points).mean()) for view, points in views if view is not None]
    return float(agree * np.exp(-CONTRADICTION * np.mean(against))) if against else float(agree)


def apart(scene: Scene, source: Tensor, motion: RigidMotion, other: RigidMotion) -> Float[Tensor, " e"]:
    """Root mean square distance between the points of scans ``source`` ``(e,)`` under two motions ``(e, ...)``."""
    turn, shift = motion.rotation - other.rotation, motion.translation - other.translation
    of_middle = (turn @ scene.middle[source][:, :, None])[:, :, 0] + shift
    about_it = torch.einsum("eab,ebc,eac->e", turn, scene.scatter[source], turn)
    return (of_middle.square().sum(-1) + about_it).clamp(min=0).sqrt()
