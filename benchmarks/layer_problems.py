"""The clouds that the layer's benchmarks register."""

import torch
from torch import Tensor

from bbr_layer import RigidMotion

# Standard deviation of the noise, as a share of the sphere's radius.
NOISE = 0.01
# Features of a point: as many as small networks give. Their noise, where their own deviation is 1.
CHANNELS, FEATURE_NOISE = 32, 0.1


def clouds(n: int, batch: int = 0, shift: float = 0.0, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """A noisy sphere twice, 8 degrees and 5 % of its radius apart."""
    generator = torch.Generator().manual_seed(0)
    shape = (batch, n, 3) if batch else (n, 3)
    P = torch.nn.functional.normalize(torch.randn(shape, generator=generator, dtype=torch.float64), dim=-1)
    truth = RigidMotion.from_rotvec(torch.tensor([0.1, 0.0, 0.1]).double(), torch.tensor([0.05, 0.0, 0.0]).double())
    noise = NOISE * torch.randn(shape, generator=generator, dtype=torch.float64)
    return (P + shift).to(dtype), (truth.inverse()(P + noise) + shift).to(dtype)


def features(n: int) -> dict[str, Tensor]:
    """Features of the points of two clouds, alike but for noise, as the layer takes them; each wants its gradient."""
    generator = torch.Generator().manual_seed(1)
    target, noise = torch.randn((2, n, CHANNELS), generator=generator)
    source = target + FEATURE_NOISE * noise
    return {"P_features": target.requires_grad_(), "Q_features": source.requires_grad_()}
