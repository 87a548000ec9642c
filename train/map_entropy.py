"""Mean map entropy: how crisp a map is, measured without any ground truth."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

# A covariance in d dimensions needs d + 1 points to have full rank; 5 serves both 2D and 3D, with one to
# spare.
MIN_NEIGHBOURS = 5
# Standard deviations below this fraction of the radius count as that fraction: perfectly flat
# neighbourhoods of simulated scans would otherwise give minus infinity, or measure nothing but rounding.
THINNEST = 1e-3
# Neighbour pairs held in memory at a time (32 bytes each).
PAIRS_PER_CHUNK = 2_000_000


def mean_map_entropy(points: Float[np.ndarray, "n d"], radius: float, *, max_queries: int = 20_000) -> float:
    """Mean over the map's points q of ``0.5 ln det(2 pi e Sigma(q))``, in nats; lower is crisper.

    ``Sigma(q)`` is the covariance (divided by the number of points) of all map points within ``radius`` of
    q, q included. Points with fewer than 5 others in reach are left out; NaN where that leaves none.
    Comparable only between maps of the same scans, in the same unit, at the same radius.

    Parameters
    ----------
    points: the map ``(n, d)``, d = 2 or 3.
    radius: in the points' unit; somewhat more than the misalignments to be seen.
    max_queries: q runs over at most about so many points, spread evenly over the rows.

    Raises
    ------
    ValueError: wrong shape, not finite, or a radius that is not positive.

    Source: J. Razlaw, D. Droeschel, D. Holz, S. Behnke, Evaluation of Registration Methods for Sparse 3D
    Laser Scans, ECMR 2015. Ours: the floor of the variances (THINNEST) and the number of neighbours.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise ValueError(f"points has shape {points.shape}; give a map as (n, 2) or (n, 3)")
    if not np.isfinite(points).all():
        raise ValueError("points holds NaN or infinity; drop those points first")
    if not (np.isfinite(radius) and radius > 0):
        raise ValueError(f"radius is {radius}; give a positive length in the unit of the points")
    tree = cKDTree(points)
    queries = points[:: max(1, -(-len(points) // max_queries))]
    reach = tree.query_ball_point(queries, radius, return_length=True)
    queries, reach = queries[reach > MIN_NEIGHBOURS], reach[reach > MIN_NEIGHBOURS]
    if len(queries) == 0:
        return float("nan")
    chunks = np.split(np.arange(len(queries)), np.flatnonzero(np.diff(np.cumsum(reach) // PAIRS_PER_CHUNK)) + 1)
    return float(sum(_entropies(tree, queries[chunk], radius).sum() for chunk in chunks)) / len(queries)


def _entropies(tree: cKDTree, queries: np.ndarray, radius: float) -> np.ndarray:
    """Entropy of the neighbourhood of each query ``(m, d)`` -> ``(m,)``."""
    pairs = cKDTree(queries).sparse_distance_matrix(tree, radius, output_type="ndarray")
    query, d = pairs["i"], queries.shape[1]
    offsets = tree.data[pairs["j"]] - queries[query]  # about the query, so that far-away maps lose no digits
    count = np.bincount(query, minlength=len(queries))

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(query, values, minlength=len(queries)) / count

    centre = np.stack([mean(offsets[:, a]) for a in range(d)], axis=1)
    covariance = np.empty((len(queries), d, d))
    for a in range(d):
        for b in range(a, d):
            covariance[:, a, b] = mean(offsets[:, a] * offsets[:, b]) - centre[:, a] * centre[:, b]
            covariance[:, b, a] = covariance[:, a, b]
    variances = np.maximum(np.linalg.eigvalsh(covariance), (THINNEST * radius) ** 2)
    return 0.5 * (d * np.log(2 * np.pi * np.e) + np.log(variances).sum(axis=1))
