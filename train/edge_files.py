"""Registered edges and the starting map in one file, so that they need not be registered again."""

from pathlib import Path

import numpy as np
import torch

from bbr_layer import RigidMotion, atomic_write
from train.damage import DAMAGED
from train.pose_graph import Edges
from train.scans import ScanSet

POSES = "world_from_scan"
MOTION = "target_from_source"
SCANS = "scans"


def save_edges(path: Path, edges: Edges, world_from_scan: RigidMotion, scans: ScanSet) -> None:
    """Write the edges' fields by name, motions as homogeneous matrices, the starting poses, and whose edges they are.

    Raises
    ------
    OSError: the file cannot be written; nothing of it is left.
    """
    fields = {name: value.numpy() for name, value in edges._asdict().items() if name != MOTION}
    motions = {MOTION: edges.target_from_source.matrix.numpy(), POSES: world_from_scan.matrix.numpy()}
    with atomic_write(path) as temporary:
        np.savez_compressed(
            temporary, allow_pickle=False, **fields, **motions, **{SCANS: np.array(scans.points_fingerprint())}
        )


def load_edges(path: Path, scans: ScanSet) -> tuple[Edges, RigidMotion]:
    """Edges and ``world_from_scan`` as ``save_edges`` wrote them, to the last bit.

    Parameters
    ----------
    path: the file. One of an earlier version does not tell whose edges it holds; it is believed.
    scans: what the edges are to join.

    Raises
    ------
    FileNotFoundError: there is no such file.
    ValueError: it is no such file, or belongs to other scans.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file of edges; map the scans to get one")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            found = {name: torch.from_numpy(arrays[name]) for name in (*Edges._fields, POSES)}
            made_from = str(arrays[SCANS]) if SCANS in arrays else None
        poses, motion = (RigidMotion.from_matrix(found.pop(name)) for name in (POSES, MOTION))
    except DAMAGED as error:
        raise ValueError(f"{path} is no file of edges ({error}); delete it and map the scans again") from error
    k, d = poses.translation.shape
    if (k, d) != (len(scans), scans.dimension):
        given = f"{len(scans)} in {scans.dimension}D were given"
        raise ValueError(f"{path} belongs to {k} scans in {d}D; {given}: name the edges of these")
    if made_from not in (None, scans.points_fingerprint()):
        raise ValueError(f"{path} belongs to other scans, as many as were given: name the edges of these")
    return Edges(target_from_source=motion, **found), poses
