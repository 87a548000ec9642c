"""Room where compiled code adds up cotangents of a batch, and the tensors that they are."""

from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from bbr_layer.pair import CloudPair

Tables = TypeVar("Tables", bound=tuple)


def room(pair: CloudPair) -> list[np.ndarray]:
    """Zeros for P, Q, their normals ``(batch, 3, points)`` and weights ``(batch, points)``, in space."""
    (batch, n, _), m = pair.P.shape, pair.Q.shape[1]
    vectors, numbers = ((batch, 3, n), (batch, 3, m)), ((batch, n), (batch, m))
    return [np.zeros(shape) for shape in (*vectors, *vectors, *numbers)]


def item_of(tables: Tables, number: int) -> Tables:
    """The same named tables of one item of a batch."""
    return type(tables)(*(table[number] for table in tables))


def as_field(adjoint: tuple, name: str, field: Tensor | None) -> Tensor | None:
    """The cotangent of a field of the pair, in its shape; None for what has none."""
    if field is None or not hasattr(adjoint, name):
        return None
    table = torch.from_numpy(getattr(adjoint, name))
    return (table if field.ndim == 2 else table[:, : field.shape[-1]].mT).to(field.dtype)
