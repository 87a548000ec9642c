"""Scans as the joint refinement and the free-space evidence read them: points, normals, trees."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from train.prepared import Prepared


@dataclass(frozen=True)
class Surface:
    """One scan, thinned, in its own frame.

    ``points``, ``normals``: ``(n, d)`` float64. ``tree``: of the points. ``spacing``: median distance from a point to
    the nearest other one, in the data's unit.
    """

    points: Float[np.ndarray, "n d"]
    normals: Float[np.ndarray, "n d"]
    tree: cKDTree
    spacing: float

    @property
    def radius(self) -> float:
        """How far a turn by one radian moves the points about the sensor, root mean square, in the data's unit."""
        return float(np.sqrt((self.points**2).sum(axis=1).mean()))


def surfaces(prepared: Prepared) -> list[Surface]:
    """The scans of ``prepared``, each with its tree."""
    found = []
    for points, normals, mask in zip(*prepared, strict=True):
        chosen = points[mask].double().numpy()
        tree = cKDTree(chosen)
        found.append(Surface(chosen, normals[mask].double().numpy(), tree, spacing_of(tree)))
    return found


def spacing_of(tree: cKDTree) -> float:
    """Median distance from a point to the nearest other one, duplicates left out; 1 where there is no other."""
    gaps = tree.query(tree.data, k=[2])[0][:, 0]
    apart = gaps[np.isfinite(gaps) & (gaps > 0)]
    return float(np.median(apart)) if len(apart) else 1.0
