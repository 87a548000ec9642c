"""M-Net: the map as a function from a place in the world to the logit of its being occupied."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

# DeepMapping's hidden widths: 64-512-512-256-128.
PAPER_WIDTHS = (64, 512, 512, 256, 128)
# Seed of the directions of the Fourier features: part of the network's definition, not of a run.
DIRECTION_SEED = 0


class MNet(nn.Module):
    """Occupancy network: a small perceptron on Fourier features of the place.

    The features are sines and cosines along fixed random directions at octave wavelengths (Tancik et al.,
    NeurIPS 2020), from twice the map's half extent downwards; they let a small network learn walls in
    seconds, where plain coordinates need thousands of steps.

    Parameters
    ----------
    dimension: 2 or 3.
    widths: hidden widths. Default (64, 64).
    levels: octaves of wavelength; 0 feeds the plain coordinates. Default 8: the finest is 1/64 of the half
        extent.
    directions: directions per octave. Default 8.

    Raises
    ------
    ValueError: a dimension other than 2 or 3, negative levels, a width or a number of directions below 1.
    """

    centre: Tensor
    scale: Tensor
    frequencies: Tensor

    def __init__(self, dimension: int, *, widths: Sequence[int] = (64, 64), levels: int = 8, directions: int = 8):
        super().__init__()
        if dimension not in (2, 3):
            raise ValueError(f"dimension is {dimension}; the world has 2 or 3 coordinates")
        if levels < 0 or directions < 1 or not widths or min(widths) < 1:
            raise ValueError(
                f"widths {tuple(widths)}, levels {levels}, directions {directions}: widths and directions "
                "must be positive and levels not negative, try (64, 64), 8 and 8"
            )
        self.register_buffer("centre", torch.zeros(dimension, dtype=torch.float64))
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))
        self.register_buffer("frequencies", _frequencies(dimension, levels, directions))
        channels = (dimension + 2 * levels * directions, *widths)
        layers: list[nn.Module] = []
        for a, b in zip(channels[:-1], channels[1:], strict=True):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.Linear(channels[-1], 1))

    @classmethod
    def paper(cls, dimension: int) -> "MNet":
        """DeepMapping's plain perceptron d-64-512-512-256-128-1."""
        return cls(dimension, widths=PAPER_WIDTHS, levels=0, directions=1)

    def fit_bounds(
        self, world_points: Float[Tensor, "*batch n d"], mask: Bool[Tensor, "*batch n"] | None = None
    ) -> None:
        """Fix the centre and half extent by the starting map: the box around its real points.

        Raises
        ------
        ValueError: no real points.
        """
        real = world_points.reshape(-1, world_points.shape[-1]) if mask is None else world_points[mask]
        if not real.shape[0]:
            raise ValueError("world_points holds no real point; the map's extent is unknown: check the mask")
        low, high = real.double().amin(0), real.double().amax(0)
        half_extent = (high - low).amax() / 2
        self.centre.copy_((low + high) / 2)
        self.scale.copy_(torch.where(half_extent > 0, half_extent, torch.ones_like(half_extent)))

    def forward(self, world_points: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n"]:
        """Logit of occupancy at each place, ``(*batch, n)``; places in the data's unit."""
        # Shifted in float64: a map far from the origin keeps its digits.
        places = ((world_points.double() - self.centre) / self.scale).to(self.frequencies.dtype)
        angles = places @ self.frequencies
        features = torch.cat((places, angles.sin(), angles.cos()), dim=-1)
        return self.layers(features)[..., 0].to(world_points.dtype)


def _frequencies(dimension: int, levels: int, directions: int) -> Tensor:
    """Angular frequencies ``(d, levels * directions)``: unit directions over wavelengths 2, 1, 1/2, ..."""
    generator = torch.Generator().manual_seed(DIRECTION_SEED)
    along = torch.randn(levels, directions, dimension, generator=generator)
    along = along / torch.linalg.vector_norm(along, dim=-1, keepdim=True)
    octaves = math.pi * 2.0 ** torch.arange(levels)
    return (octaves[:, None, None] * along).reshape(levels * directions, dimension).mT.contiguous()
