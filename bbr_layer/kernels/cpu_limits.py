"""Where distances of Eq. 7 end, for a loss that clips them, and what a pair beyond that adds: nothing; compiled."""

from typing import Any

from numba import types
from numba.extending import overload

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_math import ZERO


def limit_of(normals: Any) -> Any:
    """The square at which distances are clipped, kept behind the normals; None where none are."""
    return None if normals is None or len(normals) != 3 else normals[2][0]


@overload(limit_of, inline="always")
def _limit_of(normals):  # type: ignore[no-untyped-def]
    if normals == types.none or len(normals) != 3:
        return lambda normals: None
    return lambda normals: normals[2][0]


@compiled(forceinline=True)
def clipped(squared, limit):  # type: ignore[no-untyped-def]
    """A square, at most the limit unless that is None."""
    return squared if limit is None else min(squared, limit)


@compiled(forceinline=True)
def if_free(value, squared, limit):  # type: ignore[no-untyped-def]
    """The value; 0 where the square is clipped."""
    return value if limit is None else (value if squared < limit else ZERO)
