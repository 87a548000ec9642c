"""Where the sensor saw nothing: points along the rays between the sensor and what it hit."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Share of a ray, counted from its end, that is never called free: range noise and thick surfaces live there.
SURFACE_MARGIN = 0.05


def sample_free_space(
    points: Float[Tensor, "g n d"],
    mask: Bool[Tensor, "g n"],
    samples: int,
    generator: torch.Generator | None = None,
    margin: float = SURFACE_MARGIN,
) -> Float[Tensor, "g k d"]:
    """Points on the rays from the sensor (the origin) to each hit, ``(g, n * samples, d)``, ray by ray.

    Every ray is cut into ``samples`` equal strata and one point is drawn from each: each ray has its own
    fractions. Padded rays answer the origin. Differentiable in ``points``.

    Parameters
    ----------
    points: ``(g, n, d)`` in the sensor frame.
    mask: ``(g, n)``, True where a point is real.
    samples: points per ray, at least 1.
    generator: source of the jitter, on the device of ``points``; None: torch's global one.
    margin: share of the ray in front of the hit that is left out, in [0, 1). Default 0.05.

    Raises
    ------
    ValueError: no samples, or a margin outside [0, 1).
    """
    if samples < 1:
        raise ValueError(f"samples is {samples}; each ray needs at least one: try 3")
    if not 0 <= margin < 1:
        raise ValueError(f"margin is {margin}; it is a share of the ray in [0, 1): try {SURFACE_MARGIN}")
    g, n, d = points.shape
    jitter = torch.rand(g, n, samples, generator=generator, dtype=points.dtype, device=points.device)
    strata = torch.arange(samples, dtype=points.dtype, device=points.device)
    fractions = (strata + jitter) / samples * (1 - margin)
    hits = torch.where(mask[..., None], points, 0.0)
    return (fractions[..., None] * hits[:, :, None, :]).reshape(g, n * samples, d)
