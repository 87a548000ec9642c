"""How well poses align the scans, judged by points that the training never saw, without any truth."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from bbr_layer import RigidMotion
from train.data_module import PreparedScan, draw
from train.pose_graph import Edges

# Held-out points of one scan that are asked; evenly spread.
MOST_QUERIES = 256
# A point this many spacings off the other scan's surface, or this many away from its nearest point, counts half an
# outlier (Geman and McClure's kernel). Neighbours on one surface lie up to a few spacings apart.
OFF_SURFACE, APART = 0.5, 4.0
# Weight of the distance between the poses and the registered edges, counted like OFF_SURFACE: it decides where
# surfaces cannot, as along a corridor.
EDGE_WEIGHT = 0.1


class Alignment:
    """Score of a trajectory in [0, 1 + EDGE_WEIGHT], lower is better, comparable between poses of the same scans.

    For every edge, both ways, the held-out points of one scan are placed on the other, and their distances to its
    surface go through a kernel that counts an outlier once; points are averaged, edges by their score. It asks the
    poses alone: the loss of a network falls while it learns, whatever the poses do.

    Parameters
    ----------
    prepared: the k scans.
    edges: between them.
    """

    def __init__(self, prepared: Sequence[PreparedScan], edges: Edges):
        self.normals = [scan.normals.double().numpy() for scan in prepared]
        self.trees = [cKDTree(scan.points.double().numpy()) for scan in prepared]
        target, source = edges.target.numpy(), edges.source.numpy()
        pairs = np.concatenate((np.stack((target, source)), np.stack((source, target))), axis=1)
        order = np.argsort(pairs[0], kind="stable")  # each scan's tree is then asked once
        self.target, self.source = pairs[:, order]
        measured = edges.target_from_source
        both = np.concatenate((measured.matrix.numpy(), measured.inverse().matrix.numpy()))
        self.measured = both.astype(np.float64)[order]
        weight = np.tile(edges.score.double().numpy(), 2)[order]
        self.weight = weight if weight.sum() > 0 else np.ones_like(weight)
        spacing = np.array([scan.spacing for scan in prepared])[pairs[:, order]].mean(axis=0)
        self.spacing = np.where(spacing > 0, spacing, 1.0)
        asked = [scan.held_out[draw(len(scan.held_out), MOST_QUERIES, None)] for scan in prepared]
        clouds = [scan.points.double().numpy()[rows] for scan, rows in zip(prepared, asked, strict=True)]
        self.queries = np.concatenate([clouds[number] for number in self.source])
        self.pair = np.repeat(np.arange(len(self.source)), [len(clouds[number]) for number in self.source])

    def __call__(self, world_from_scan: RigidMotion) -> float:
        """Score of the poses ``(k, ...)``."""
        poses = world_from_scan.matrix.detach().double().cpu().numpy()
        relative = np.linalg.inv(poses[self.target]) @ poses[self.source]
        placed, measured = self._placed(relative), self._placed(self.measured)
        apart, off_surface = self._distances(placed)
        spacing = self.spacing[self.pair]
        surface = outlier((off_surface / (OFF_SURFACE * spacing)) ** 2 + (apart / (APART * spacing)) ** 2)
        edge = outlier(((placed - measured) ** 2).sum(axis=1) / (OFF_SURFACE * spacing) ** 2)
        count = np.bincount(self.pair, minlength=len(self.target))
        value = np.bincount(self.pair, surface + EDGE_WEIGHT * edge, minlength=len(self.target)) / count
        return float(np.average(value, weights=self.weight))

    def _placed(self, target_from_source: Float[np.ndarray, "p d1 d1"]) -> Float[np.ndarray, "q d"]:
        motion = target_from_source[self.pair]
        return np.einsum("qab,qb->qa", motion[:, :-1, :-1], self.queries) + motion[:, :-1, -1]

    def _distances(self, placed: Float[np.ndarray, "q d"]) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]]:
        """Distance of each query to the nearest point of its target scan, and to the plane through that point."""
        apart, off_surface = np.empty(len(placed)), np.empty(len(placed))
        targets = self.target[self.pair]
        for number in np.unique(targets):
            rows = slice(*np.searchsorted(targets, (number, number + 1)))
            apart[rows], nearest = self.trees[number].query(placed[rows])
            offset = placed[rows] - self.trees[number].data[nearest]
            off_surface[rows] = np.abs((offset * self.normals[number][nearest]).sum(axis=1))
        return apart, off_surface


def outlier(squared: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
    """Geman and McClure's kernel: 0 at 0, 1/2 at 1, 1 far away."""
    return squared / (1 + squared)
