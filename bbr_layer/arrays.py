"""Numpy arrays where tensors are meant: converted on the way in, and back on the way out."""

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import torch

First = TypeVar("First")
Rest = ParamSpec("Rest")
Answer = TypeVar("Answer")


def numpy_too(function: Callable[Concatenate[First, Rest], Answer]) -> Callable[Concatenate[First, Rest], Answer]:
    """A function of tensors that answers in numpy where its first argument is an array, or a named tuple of arrays."""

    @wraps(function)
    def either(first: First, /, *args: Rest.args, **kwargs: Rest.kwargs) -> Answer:
        if not isinstance(first[0] if isinstance(first, tuple) else first, np.ndarray):
            return function(first, *args, **kwargs)
        given = {name: tensors(x) for name, x in kwargs.items()}
        return arrays(function(tensors(first), *map(tensors, args), **given))

    return either


def tensors(value: Any) -> Any:
    """Arrays, alone or in a named tuple, as tensors; anything else as it is."""
    if isinstance(value, tuple):
        return type(value)(*map(tensors, value))
    return from_array(value) if isinstance(value, np.ndarray) else value


def from_array(array: np.ndarray) -> torch.Tensor:
    """A tensor of its own memory: arrays may be read-only, or run backwards."""
    return torch.tensor(np.ascontiguousarray(array))


def arrays(value: Any) -> Any:
    """Tensors, alone or in a named tuple, as arrays without a gradient; anything else as it is."""
    if isinstance(value, tuple):
        return type(value)(*map(arrays, value))
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
