"""torch's checks of gradients by differences, with the shapes checked once.

They call a function hundreds of times with inputs of the same shapes, and the checks of shapes take most of
the time of such a test.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import jaxtyping
import torch


@contextmanager
def shapes_unchecked() -> Iterator[None]:
    """As it is outside the tests: jaxtyping checks nothing."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def gradcheck(function, inputs, **options) -> bool:
    """torch.autograd.gradcheck after one call with the shapes checked."""
    return _checked(torch.autograd.gradcheck, function, inputs, options)


def gradgradcheck(function, inputs, **options) -> bool:
    """torch.autograd.gradgradcheck after one call with the shapes checked."""
    return _checked(torch.autograd.gradgradcheck, function, inputs, options)


def _checked(check, function, inputs, options) -> bool:
    function(*inputs)
    with shapes_unchecked():
        return check(function, inputs, **options)
