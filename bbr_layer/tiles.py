"""Nearest neighbours on an accelerator: brute force by explicit differences, a tile of queries at a time."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bbr_layer.geometry import RigidMotion

# Pairs per tile: 2^24 float32 distances are 64 MiB.
PAIRS_PER_TILE = 2**24


class Tiled:
    """One pair of clouds."""

    def __init__(self, P: Tensor, Q: Tensor):
        self.P, self.Q = P, Q
        self.asked = self.searched = self.looked_up = 0

    def __call__(self, motion: RigidMotion) -> tuple[Tensor, Tensor]:
        """Indices of the nearest target points and whether the choice is mutual, both ``(m,)``."""
        dtype = motion.translation.dtype
        P, Q = self.P.to(dtype), self.Q.to(dtype)
        index = nearest_by_tiles(motion(Q), P)
        nearest_Q = nearest_by_tiles(motion.inverse()(P), Q)
        self.asked = self.searched = self.looked_up = self.asked + len(P) + len(Q)
        return index, nearest_Q[index] == torch.arange(len(Q), device=Q.device)


def nearest_by_tiles(queries: Float[Tensor, "k d"], points: Float[Tensor, "n d"]) -> Int[Tensor, "k"]:
    """Index of the nearest point for each query, the first of equally near ones."""
    rows = max(1, PAIRS_PER_TILE // len(points))
    return torch.cat([(tile[:, None, :] - points).square().sum(-1).argmin(1) for tile in queries.split(rows)])
