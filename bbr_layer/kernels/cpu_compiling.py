"""How the functions of the CPU are compiled: with which options, kept where, and what is said while people wait."""

import inspect
import logging
import warnings
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.event import Event, Listener, register

MESSAGE = (
    "bbr_layer is being compiled for this processor, a minute or two the first time: what is kept on disk is not "
    "compiled again"
)
LOGGER = logging.getLogger("bbr_layer")
# Reassociation lets sums run in vector registers; infinities and NaN never enter, inputs are checked at the door.
FAST = {"nnan", "ninf", "nsz", "contract", "arcp", "reassoc", "afn"}


def cacheable() -> bool:
    """Whether Numba finds a folder to keep what it compiles: beside the code, or the user's. If not, warns."""
    try:
        njit(cache=True)(cacheable)
    except RuntimeError:
        sentence = "neither the folder of bbr_layer nor the user's cache can be written to: every process compiles "
        warnings.warn(sentence + "anew, for about a minute; set NUMBA_CACHE_DIR to a folder that can", stacklevel=2)
        return False
    return True


# Nobody calls a compiled function through C.
COMMON: dict[str, Any] = {"error_model": "numpy", "cache": cacheable(), "nogil": True, "no_cfunc_wrapper": True}


def compiled(**more: Any) -> Callable[[Callable], Callable]:
    """Numba's decorator with the options of all sweeps; results are cached on disk.

    Whatever wraps a function, as checks of its arguments do, is taken off first: Numba compiles what was written.
    """
    decorate = njit(fastmath=FAST, **COMMON, **more)
    return lambda function: decorate(inspect.unwrap(function))


def exact(function: Callable) -> Callable:
    """Numba's decorator without fast arithmetic, for what is not a sweep."""
    return njit(**COMMON)(inspect.unwrap(function))


class Told(Listener):
    """Says once in a process that functions of ours are being compiled; what the cache holds is not."""

    def __init__(self) -> None:
        self.told = False

    def on_start(self, event: Event) -> None:
        if not self.told and event.data["dispatcher"].py_func.__module__.startswith("bbr_layer."):
            self.told = True
            LOGGER.warning(MESSAGE)

    def on_end(self, event: Event) -> None:
        pass


register("numba:compile", Told())
