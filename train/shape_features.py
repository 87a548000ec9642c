"""What the surface around a point looks like, the same from everywhere: fast point feature histograms.

Source: R. Rusu, N. Blodow, M. Beetz, Fast Point Feature Histograms for 3D Registration, ICRA 2009.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from train.surfaces import Surface

# Bins of each of the three angles, as in the source.
BINS = 11
# Radius of the neighbourhood in point spacings.
RADIUS = 6.0


# Neighbours whose normals point apart by more than this cosine count as one seen from behind; and by how much fewer of
# them another place of the sensor must leave than the origin does.
APART, FEWER = -0.5, 0.01


def common_view(scans: Sequence[Surface]) -> int:
    """From where the scans were seen: 0 for their origin, i for far off along axis i - 1.

    A surface shows its sensor one side, so that normals turned towards it change their sides nowhere between
    neighbours. Where the origin is not the sensor they do; then the axis is taken for which they change least.
    """
    views = range(scans[0].points.shape[1] + 1)
    behind = np.mean([[_behind(scan, view) for view in views] for scan in scans], axis=0)
    best = int(np.argmin(behind))
    return best if behind[best] < behind[0] - FEWER else 0


def _behind(scan: Surface, view: int) -> float:
    near = scan.tree.query(scan.points, k=min(6, len(scan.points)))[1][:, 1:]
    normals = _turned(scan, view)
    return float(np.mean(np.einsum("nd,nkd->nk", normals, normals[near]) < APART))


def _turned(scan: Surface, view: int) -> Float[np.ndarray, "n d"]:
    towards = -scan.points if view == 0 else np.eye(scan.points.shape[1])[view - 1]
    return scan.normals * np.where((scan.normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]


def shape_features(scan: Surface, radius: float, view: int) -> Float[np.ndarray, "n 33"]:
    """Histograms of the angles between the normals of points within ``radius``, with ``common_view`` of all scans."""
    normals, tree = _turned(scan, view), scan.tree
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
        whole[:, column] += np.bincount(here, near * simple[there, column], minlength=n) / np.bincount(
            here, near, minlength=n
        ).clip(1e-12)
    return whole / np.maximum(np.linalg.norm(whole, axis=1, keepdims=True), 1e-12)


def matched(target: Float[np.ndarray, "n f"], source: Float[np.ndarray, "m f"], most: int) -> Int[np.ndarray, "c 2"]:
    """At most ``most`` pairs, target then source, where one is nearest to the other in features; best first."""
    there, back = cKDTree(target).query(source)[1], cKDTree(source).query(target)[1]
    pairs = np.concatenate(
        (np.column_stack((there, np.arange(len(source)))), np.column_stack((np.arange(len(target)), back)))
    )
    pairs = np.unique(pairs, axis=0)
    apart = np.linalg.norm(target[pairs[:, 0]] - source[pairs[:, 1]], axis=1)
    return pairs[np.argsort(apart, kind="stable")[:most]]
