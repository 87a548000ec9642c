"""Whether this machine has the device that was asked for: to be told at once, not after all scans are registered."""

from collections.abc import Callable

import torch

# Devices that not every machine has.
PRESENT: dict[str, Callable[[], bool]] = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available}


def check_device(name: str) -> None:
    """Nothing, where training can run on ``name``.

    Raises
    ------
    ValueError: this machine has no such device, or torch cannot use it.
    """
    if name in PRESENT and not PRESENT[name]():
        raise ValueError(f"device is {name!r}, which torch does not find on this machine: give cpu or auto")
