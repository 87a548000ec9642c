"""What can be told wrong of a run before a scan is read: not when all are registered."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from bbr_layer import scan_paths
from train.config import MapConfig
from train.run_folder import EDGES, MAP_FILES

# Devices that not every machine has.
PRESENT: dict[str, Callable[[], bool]] = {"cuda": torch.cuda.is_available, "mps": torch.backends.mps.is_available}


def check_beforehand(config: MapConfig, out: Path, scans: Sequence[Path], files: Sequence[Path | None]) -> None:
    """Refuse a device that is not there, and what lies in the folder of the run and would be replaced or misread.

    Parameters
    ----------
    out: the folder of the run.
    scans: where scans are read from.
    files: poses and edges that are read, where any are.

    Raises
    ------
    ValueError: this machine has no such device, or torch cannot use it; the scans are read from ``out``; or one of the
        files is a part of the run that ``out`` holds.
    FileNotFoundError: a folder among the scans holds none.
    """
    if config.device in PRESENT and not PRESENT[config.device]():
        raise ValueError(f"device is {config.device!r}, which torch does not find on this machine: give cpu or auto")
    folders = [folder for folder in scans if folder.is_dir()]
    read = {folder.resolve() for folder in folders} | {scan_paths(folder)[0].parent.resolve() for folder in folders}
    if out.resolve() in read:
        raise ValueError(
            f"out is {out}, the folder of the scans, where map.ply would be read as a scan the next time: give "
            "another folder"
        )
    for file in files:
        if file is not None and file.resolve().parent == out.resolve() and file.name in (EDGES, *MAP_FILES):
            raise ValueError(f"{file} is a part of the run in {out} that this one replaces: give another folder as out")
