"""Which sweeps are used where, and why."""

import importlib.util
import logging
import os
from collections.abc import Callable
from functools import cache
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from bbr_layer.kernels import reference
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms

# Names the backend for every device, where set: "numba", "triton" or "torch".
VARIABLE = "BBR_BACKEND"
NAMES = ("numba", "triton", "torch")
LOGGER = logging.getLogger("bbr_layer")


class Backend(NamedTuple):
    """What computes the closed forms of the losses.

    Parameters
    ----------
    name: ``"numba"`` (compiled, CPU), ``"triton"`` (compiled, GPU) or ``"torch"`` (any device, slower).
    reason: why, in words.
    """

    name: str
    reason: str


class Sweeps(NamedTuple):
    """The functions of a backend, and what they can do."""

    name: str
    gradient: Callable[[SoftTerms, Scene], tuple[Tensor, Scene]]
    directional: Callable[[SoftTerms, Scene, Direction], tuple[Scene, Scene]]
    lacks: Callable[[SoftTerms, Scene], str]  # what it cannot do of what is asked, in words


TORCH = Sweeps("torch", reference.soft_gradient, reference.soft_directional, lambda terms, scene: "")


def backend(device: torch.device | str = "cpu") -> Backend:
    """What computes on ``device``, and why; the environment variable ``BBR_BACKEND`` overrides the choice.

    Matching by features (on a GPU, or between more than 2^25 pairs of points), clipping (on a GPU, or with padded
    points) and an epsilon too small for exponentials that may underflow (``lacks`` of each backend) are computed by
    torch whatever the backend; the log says so once.

    Raises
    ------
    ValueError: ``BBR_BACKEND`` names no backend, or one that is not installed.

    >>> backend("cpu").name in ("numba", "torch")
    True
    """
    wanted, kind = os.environ.get(VARIABLE), torch.device(device).type
    fitting = {"cpu": "numba", "cuda": "triton"}.get(kind)
    if wanted:
        if wanted not in NAMES:
            raise ValueError(f"{VARIABLE} is {wanted!r}; it must be one of {', '.join(NAMES)}")
        if wanted != "torch" and importlib.util.find_spec(wanted) is None:
            raise ValueError(f"{VARIABLE} is {wanted!r}, which is not installed: pip install {wanted}, or unset it")
        if wanted in ("torch", fitting):
            return Backend(wanted, f"{VARIABLE} says so")
        return Backend("torch", f"{VARIABLE} says {wanted}, which does not compute on {kind}")
    if fitting is None:
        return Backend("torch", f"nothing is compiled for {kind}")
    if importlib.util.find_spec(fitting) is None:
        return Backend("torch", f"{fitting} is not installed: pip install {fitting} for compiled sweeps on {kind}")
    return Backend(fitting, f"the points are on {kind} and {fitting} is installed")


def sweeps_for(terms: SoftTerms, scene: Scene) -> Sweeps:
    """The fastest functions that can compute this."""
    name = backend(scene.pair.P.device).name
    if name == "torch":
        return TORCH
    chosen = _compiled(name)
    lacking = chosen.lacks(terms, scene)
    if not lacking:
        return chosen
    tell_slow(name, lacking)
    return TORCH


@cache
def tell_slow(name: str, lacking: str) -> None:
    """Say once in a process that something is slow, and why."""
    LOGGER.warning("%s is computed by torch, slower than what %s has compiled", lacking, name)


def _compiled(name: str) -> Sweeps:
    # Imported where it is first needed: both compilers take a second or more to load.
    module: ModuleType = importlib.import_module(f"bbr_layer.kernels.{'cpu' if name == 'numba' else 'gpu'}")
    return Sweeps(name, module.gradient, module.directional, module.lacks)
