"""How alike the two points of a matched pair are: how near to each other, and how much of one direction the normals."""

from jaxtyping import Float
from torch import Tensor

# How far apart the points lie, in point spacings, and how far from 1 the cosine of their normals, where a pair counts
# half. Where the surface bends between the two points, neither plane is that of the other. Measured:
# benchmarks/likeness.md.
POINTS_APART, NORMALS_APART = 1.0, 0.1


def likeness(
    offsets: Float[Tensor, "batch m d"],
    normals: tuple[Float[Tensor, "batch m d"], Float[Tensor, "batch m d"]],
    spacing: Float[Tensor, "batch"],
) -> Float[Tensor, "batch m"]:
    """``1 / (1 + |offset|^2 / spacing^2) x 0.1 / (1.1 - |cos|)``, in (0, 1]; ``normals`` are unit ones of either side.

    Generalised ICP (Segal, Haehnel and Thrun, 2009) has the second factor, with 0.001: what a covariance of a flat disk
    at either point leaves of a pair's weight across them.
    """
    apart = offsets.square().sum(-1) / (POINTS_APART * spacing[:, None]).square()
    cosine = (normals[0] * normals[1]).sum(-1).abs()
    return NORMALS_APART / ((1 + apart) * (1 - cosine + NORMALS_APART))
