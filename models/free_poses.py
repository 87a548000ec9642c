"""Corrections of poses without a network: each scan has its own."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.scan_batch import Localisation, ScanBatch


class FreePoses(Localisation):
    """The correction of each scan, learned directly; zero at first.

    L-Net must tell neighbouring scans apart by their points before it can move them apart. Here nothing is shared, so
    that nothing must be memorised; and nothing is known of scans that were not there.

    Parameters
    ----------
    count: scans in the whole sequence.
    dimension: 2 or 3.
    turn: radians that a rotation moves when its number changes by 1. One point spacing over the range of a scan lets
        the far points of a turned scan move as fast as those of a shifted one. Default 1.

    Raises
    ------
    ValueError: a count below 1, another dimension, a turn that is not positive.
    """

    units: Tensor

    def __init__(self, count: int, dimension: int, turn: float = 1.0):
        super().__init__()
        if count < 1:
            raise ValueError(f"count is {count}; there is at least one scan")
        if dimension not in (2, 3):
            raise ValueError(f"dimension is {dimension}; scans have 2 or 3 coordinates")
        if not turn > 0:
            raise ValueError(f"turn is {turn}; it is an angle in radians and must be positive: try 0.01")
        rotations = dimension * (dimension - 1) // 2
        units = torch.ones(rotations + dimension)
        units[:rotations] = turn
        self.register_buffer("units", units)
        self.table = nn.Parameter(torch.zeros(count, rotations + dimension))

    def corrections(self, batch: ScanBatch) -> Float[Tensor, "g k"]:
        return self.table[batch.index] * self.units
