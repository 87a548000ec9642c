"""Which points of a finished map belong to things that moved: those that more scans saw through than found."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from train.free_space_evidence import PointEvidence, point_evidence, range_views
from train.pose_graph import Edges
from train.prepared import prepare
from train.scans import ScanSet
from train.surfaces import Surface, spacing_of, surfaces

# Scans and their points that tell whether the sensor was at the origin.
ASKED_SCANS, ASKED_POINTS = 5, 1000
# Edges that were believed less bear no witness.
BELIEVED = 0.05


class MovingPoints:
    """The evidence on every point of a map, scan after scan.

    Parameters
    ----------
    scans: the k scans.
    edges: pairs of scans that see the same place; None: nobody bears witness, and nothing moved.
    world_from_scan: poses ``(k, d + 1, d + 1)``.
    """

    def __init__(self, scans: ScanSet, edges: Edges | None, world_from_scan: Float[np.ndarray, "k d1 d1"]):
        evidence = [] if edges is None else _evidence(scans, edges, world_from_scan)
        nobody = [PointEvidence(np.zeros(len(scan)), np.zeros(len(scan))) for scan in scans.points]
        parts = evidence or nobody
        self.found = np.concatenate([part.found for part in parts])
        self.seen_through = np.concatenate([part.seen_through for part in parts])

    @property
    def moved(self) -> Bool[np.ndarray, " n"]:
        """Whether each point is taken to have moved."""
        return PointEvidence(self.found, self.seen_through).moved

    @property
    def share(self) -> Float[np.ndarray, " n"]:
        """Of the scans that looked, the share that saw through the point; 0 where none looked."""
        return self.seen_through / np.maximum(self.found + self.seen_through, 1)


def _evidence(scans: ScanSet, edges: Edges, world_from_scan: Float[np.ndarray, "k d1 d1"]) -> list[PointEvidence]:
    few = slice(None, None, max(1, len(scans) // ASKED_SCANS))
    some = replace(
        scans,
        points=scans.points[few],
        names=scans.names[few],
        timestamps=scans.timestamps[few],
        start=None,
        truth=None,
    )
    views = range_views(scans, surfaces(prepare(some, ASKED_POINTS)))
    whole = []
    for points in scans.points:
        tree = cKDTree(points)
        whole.append(Surface(points, np.zeros_like(points), tree, spacing_of(tree)))
    believed = (edges.score > BELIEVED).numpy()
    pairs = np.stack((edges.target.numpy(), edges.source.numpy()), axis=1)[believed]
    return point_evidence(scans.points, (whole, views), pairs, world_from_scan)
