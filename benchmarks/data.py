"""Where the benchmarks find real clouds."""

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

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
