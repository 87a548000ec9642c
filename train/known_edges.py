"""Edges without registration: read from a file, or drawn between scans that known poses put close together."""

import hashlib
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree

from bbr_layer import RigidMotion
from train.config import EdgeConfig
from train.edge_files import load_edges
from train.pose_graph import Edges
from train.scans import Progress, ScanSet, silent

# Scans see the same place when they stand within this share of their median range.
REACH = 0.5


class KnownEdges:
    """Stands in for the registration: the given poses, and the edges of a file or those that the poses suggest.

    Parameters
    ----------
    path: a file as ``save_edges`` writes it; None: window and neighbours in space, measured by the poses themselves.
    """

    def __init__(self, path: Path | None = None):
        self.path = path

    @property
    def origin(self) -> str:
        """A word for where the edges come from; another one for other contents of the file."""
        if self.path is None:
            return "poses"
        if not self.path.is_file():
            raise FileNotFoundError(f"{self.path}: there is no such file of edges; map the scans to get one")
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

    def __call__(self, scans: ScanSet, config: EdgeConfig, progress: Progress = silent) -> tuple[Edges, RigidMotion]:
        """Edges, and ``scans.start``.

        Raises
        ------
        ValueError: the scans have no starting poses, or the file does not fit them.
        FileNotFoundError: there is no such file.
        """
        if scans.start is None:
            raise ValueError("the scans came without poses; give their file, or map them")
        poses = RigidMotion.from_matrix(torch.from_numpy(scans.start))
        edges = neighbouring(scans, poses, config) if self.path is None else load_edges(self.path, scans)[0]
        progress("edges", len(edges.target), len(edges.target))
        return edges, poses


def neighbouring(scans: ScanSet, world_from_scan: RigidMotion, config: EdgeConfig) -> Edges:
    """Each scan with the window after it and with its nearest later scans in space; no edge is measured.

    Their motions are those of the poses and their information the identity, so a term that compares poses with
    edges learns nothing from them.
    """
    k, d = len(scans), scans.dimension
    window = [(i, j) for i in range(k) for j in range(i + 1, min(i + 1 + config.window, k))]
    loops = _near_in_space(scans, world_from_scan.translation.numpy(), config)
    target, source = torch.tensor(window + loops).unbind(1)
    size = d * (d + 1) // 2
    return Edges(
        target=target,
        source=source,
        target_from_source=world_from_scan.between(target, source),
        information=torch.eye(size, dtype=torch.float64).expand(len(target), size, size).clone(),
        centre=torch.from_numpy(np.stack([points.mean(axis=0) for points in scans.points]))[source],
        score=torch.ones(len(target), dtype=torch.float64),
        kind=torch.tensor([int(j - i > 1) for i, j in window] + [2] * len(loops)),
    )


def _near_in_space(scans: ScanSet, places: Float[np.ndarray, "k d"], config: EdgeConfig) -> list[tuple[int, int]]:
    far = np.median([np.median(np.linalg.norm(points, axis=1)) for points in scans.points])
    pairs = []
    for i, near in enumerate(cKDTree(places).query_ball_point(places, REACH * far)):
        later = [j for j in near if j > i + config.window]
        distance = np.linalg.norm(places[later] - places[i], axis=1) if later else np.zeros(0)
        pairs += [(i, later[n]) for n in np.argsort(distance, kind="stable")[: config.loops_per_scan]]
    return pairs
