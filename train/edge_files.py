"""Registered edges and the starting map in one file, so that they need not be registered again."""

import zipfile
from pathlib import Path

import numpy as np
import torch

from bbr_layer import RigidMotion, atomic_write
from train.pose_graph import Edges

POSES = "world_from_scan"
MOTION = "target_from_source"


def save_edges(path: Path, edges: Edges, world_from_scan: RigidMotion) -> None:
    """Write the edges' fields by name, motions as homogeneous matrices, and the starting poses.

    Raises
    ------
    OSError: the file cannot be written; nothing of it is left.
    """
    fields = {name: value.numpy() for name, value in edges._asdict().items() if name != MOTION}
    motions = {MOTION: edges.target_from_source.matrix.numpy(), POSES: world_from_scan.matrix.numpy()}
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **fields, **motions)


def load_edges(path: Path, scans: int) -> tuple[Edges, RigidMotion]:
    """Edges and ``world_from_scan`` as ``save_edges`` wrote them, to the last bit.

    Parameters
    ----------
    path: the file.
    scans: how many scans there are.

    Raises
    ------
    FileNotFoundError: there is no such file.
    ValueError: it is no such file, or belongs to another number of scans.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such file of edges; map the scans to get one")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            found = {name: torch.from_numpy(arrays[name]) for name in (*Edges._fields, POSES)}
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is no file of edges ({error}); delete it and map the scans again") from error
    poses = RigidMotion.from_matrix(found.pop(POSES))
    if len(poses.translation) != scans:
        raise ValueError(f"{path} belongs to {len(poses.translation)} scans; {scans} were given")
    motion = RigidMotion.from_matrix(found.pop(MOTION))
    return Edges(target_from_source=motion, **found), poses
