"""The clouds that the layer's benchmarks register."""

import torch
from torch import Tensor

from bbr_layer import RigidMotion

# Standard deviation of the noise, as a share of the sphere's radius.
NOISE = 0.01


def clouds(n: int, batch: int = 0, shift: float = 0.0, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """A noisy sphere twice, 8 degrees and 5 % of its radius apart."""
    generator = torch.Generator().manual_seed(0)
    shape = (batch, n, 3) if batch else (n, 3)
    P = torch.nn.functional.normalize(torch.randn(shape, generator=generator, dtype=torch.float64), dim=-1)
    truth = RigidMotion.from_rotvec(torch.tensor([0.1, 0.0, 0.1]).double(), torch.tensor([0.05, 0.0, 0.0]).double())
    noise = NOISE * torch.randn(shape, generator=generator, dtype=torch.float64)
    return (P + shift).to(dtype), (truth.inverse()(P + noise) + shift).to(dtype)
