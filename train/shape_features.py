"""What the surface around a point looks like, the same from everywhere: fast point feature histograms.

Source: R. Rusu, N. Blodow, M. Beetz, Fast Point Feature Histograms for 3D Registration, ICRA 2009.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from train.surfaces import Surface

# Bins of each of the three angles, as in the source.
BINS = 11
# Radius of the neighbourhood in point spacings.
RADIUS = 6.0


# Neighbours whose normals point apart by more than this cosine count as one seen from behind; and by how much fewer of
# them another place of the sensor must leave than the origin does.
APART, FEWER = -0.5, 0.01


def outward(scan: Surface) -> Float[np.ndarray, "n d"]:
    """Normals with their signs chosen alike in every scan: towards what the scan was seen from.

    A surface shows its sensor one side, so that signs chosen towards it change nowhere between neighbours. Where the
    origin is not the sensor they do; then it is taken to have looked along the axis for which they change least.
    """
    return _turned(scan, _view(scan))


def seen_from_origin(scan: Surface) -> bool:
    """Whether the sensor seems to have been at the origin, and not far off along an axis."""
    return _view(scan) == 0


def _view(scan: Surface) -> int:
    """0 for the origin, i for far off along axis i - 1: from where the fewest neighbours are seen from behind."""
    near = scan.tree.query(scan.points, k=min(6, len(scan.points)))[1][:, 1:]
    behind = []
    for view in range(scan.points.shape[1] + 1):
        normals = _turned(scan, view)
        behind.append(np.mean(np.einsum("nd,nkd->nk", normals, normals[near]) < APART))
    best = int(np.argmin(behind))
    return best if behind[best] < behind[0] - FEWER else 0


def _turned(scan: Surface, view: int) -> Float[np.ndarray, "n d"]:
    towards = -scan.points if view == 0 else np.eye(scan.points.shape[1])[view - 1]
    return scan.normals * np.where((scan.normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def shape_features(scan: Surface, radius: float) -> Float[np.ndarray, "n 33"]:
    """Histograms of the angles between each point's normal and those of its neighbours within ``radius``."""
    normals, tree = outward(scan), scan.tree
    pairs = tree.sparse_distance_matrix(tree, radius, output_type="ndarray")
    pairs = pairs[pairs["i"] != pairs["j"]]
    here, there, apart = pairs["i"], pairs["j"], np.maximum(pairs["v"], 1e-12)
    direction = (scan.points[there] - scan.points[here]) / apart[:, None]
    u, other = normals[here], normals[there]
    v = np.cross(u, direction)
    v /= np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-12)
    w = np.cross(u, v)
    angles = np.stack(
        (
            (v * other).sum(axis=1),
            (u * direction).sum(axis=1),
            np.arctan2((w * other).sum(axis=1), (u * other).sum(axis=1)) / np.pi,
        )
    )
    bins = np.minimum(((angles + 1) / 2 * BINS).astype(np.int64), BINS - 1)
    n = len(scan.points)
    simple = np.zeros((n, 3 * BINS))
    for number, chosen in enumerate(bins):
        np.add.at(simple, (here, number * BINS + chosen), 1.0)
    count = np.maximum(np.bincount(here, minlength=n), 1)
    simple /= count[:, None]
    whole = simple.copy()
    near = 1 / np.maximum(apart, radius / 10)
    for column in range(3 * BINS):
        whole[:, column] += np.bincount(here, near * simple[there, column], minlength=n) / np.bincount(here, near, minlength=n).clip(1e-12)
    return whole / np.maximum(np.linalg.norm(whole, axis=1, keepdims=True), 1e-12)


def matches(target: Float[np.ndarray, "n f"], source: Float[np.ndarray, "m f"]) -> Float[np.ndarray, "c 2"]:
    """Each source point with the target point of the nearest feature: numbers, target then source."""
    return np.column_stack((cKDTree(target).query(source)[1], np.arange(len(source))))
