"""Where the benchmarks find real clouds."""

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bbr_layer import RigidMotion

PROJECT = Path(__file__).resolve().parent.parent


def data_folder() -> Path:
    """The folder of real clouds: BBR_DATA, or beside the project.

    Raises
    ------
    FileNotFoundError: there is none.
    """
    folder = Path(os.environ.get("BBR_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder of real clouds at {folder}: set BBR_DATA to one")
    return folder


def model(name: str) -> Tensor:
    """Points of one full model, ``(n, 3)`` float64."""
    return torch.from_numpy(np.load(data_folder() / f"model_{name}.npz")["points"]).double()


def scan(name: str) -> Tensor:
    """The points ``(n, 3)`` of one of the bunny's range scans, put in place by its known pose, float64."""
    arrays = np.load(data_folder() / "seq_stanford_bunny.npz")
    number = arrays["names"].tolist().index(f"{name}.ply")
    points = arrays["points"][arrays["offsets"][number] : arrays["offsets"][number + 1]]
    return RigidMotion.from_matrix(torch.from_numpy(arrays["poses"][number]).double())(
        torch.from_numpy(points).double()
    )
