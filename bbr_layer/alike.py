"""Motions that bring a cloud to the same place."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from bbr_layer.geometry import RigidMotion
from bbr_layer.pair import CloudPair, centre_and_radius

# Alike: the cloud's rim lies within this share of a point spacing of where it lay. Over the last tenth of its steps a
# stage that converged moves it less; starts that were so near after soft buddies are taken to end alike. Chosen.
ALIKE = 0.1


def moved_little(first: RigidMotion, second: RigidMotion, pair: CloudPair) -> Tensor:
    """Whether the centred source lies as one motion brings it where the other does.

    Parameters
    ----------
    first, second: ``(batch, ...)`` motions between the centred clouds, of shapes that broadcast.
    """
    _, radius = centre_and_radius(pair.Q, pair.Q_mask)
    turn = torch.linalg.matrix_norm(second.rotation - first.rotation) / 2**0.5
    shift = torch.linalg.vector_norm(second.translation - first.translation, dim=-1)
    more = (..., *[None] * (turn.ndim - 1))
    return turn * radius[more] + shift < ALIKE * pair.known_spacing()[more]


def leaders(alike: Bool[Tensor, "batch count count"]) -> Int[Tensor, "batch count"]:
    """For each of ``count`` motions the first one that is alike and follows no other itself."""
    numbers = torch.arange(alike.shape[1], device=alike.device)
    first = numbers.expand(alike.shape[:2]).clone()
    for number in range(1, alike.shape[1]):
        leading = (alike[:, number] & (first == numbers))[:, :number]
        first[:, number] = torch.where(leading.any(1), leading.int().argmax(1), number)
    return first
