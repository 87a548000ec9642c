"""Numpy arrays where tensors are meant: converted on the way in, and back on the way out."""

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import torch

Fields = TypeVar("Fields", bound=tuple[Any, ...])
Rest = ParamSpec("Rest")
Answer = TypeVar("Answer")


def numpy_too(method: Callable[Concatenate[Fields, Rest], Answer]) -> Callable[Concatenate[Fields, Rest], Answer]:
    """A method of a named tuple of tensors that answers in numpy where the fields are numpy arrays."""

    @wraps(method)
    def either(self: Fields, /, *args: Rest.args, **kwargs: Rest.kwargs) -> Answer:
        if not isinstance(self[0], np.ndarray):
            return method(self, *args, **kwargs)
        given = {name: tensors(x) for name, x in kwargs.items()}
        return arrays(method(tensors(self), *map(tensors, args), **given))

    return either


def tensors(value: Any) -> Any:
    """Arrays, alone or in a named tuple, as tensors; anything else as it is."""
    if isinstance(value, tuple):
        return type(value)(*map(tensors, value))
    return torch.as_tensor(value) if isinstance(value, np.ndarray) else value


def arrays(value: Any) -> Any:
    """Tensors, alone or in a named tuple, as arrays without a gradient; anything else as it is."""
    if isinstance(value, tuple):
        return type(value)(*map(arrays, value))
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
