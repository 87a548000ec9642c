"""A simulated run as a folder of files, ready to be mapped."""

import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import yaml

from bbr_layer import write_cloud, write_poses_tum
from train.simulate import SimulatedScans

SETTINGS_FILE = "settings.yaml"
TRUTH_FILE = "truth_tum.txt"
# In a folder of its own: beside the scans it would be read as one more of them.
WORLD_FILE = Path("world", "world.ply")
# What an earlier simulation left; a folder that holds anything else is not replaced.
OWN_FILES = re.compile(rf"\d+\.ply|{re.escape(SETTINGS_FILE)}|{re.escape(TRUTH_FILE)}|{WORLD_FILE.parts[0]}")
SCAN_DIGITS = 3
NAME_BYTES = 4


def write_simulation(folder: str | Path, simulated: SimulatedScans) -> None:
    """Write ``simulated`` into ``folder``, all of it or nothing; an earlier simulation there is replaced.

    ``000.ply, 001.ply, ...``: the scans in metres, each in its sensor frame, z = 0 in 2D, with a column
    ``mover`` that is 1 for points on a mover. ``truth_tum.txt``: true ``world_from_scan`` with
    timestamps in seconds. ``world/world.ply``: all that stands still. ``settings.yaml``: the ``WorldSettings``.

    Raises
    ------
    ValueError: ``folder`` is a file, or holds something else than an earlier simulation.
    OSError: ``folder`` cannot be written.
    """
    digits = max(SCAN_DIGITS, len(str(len(simulated.points) - 1)))
    with _whole_folder(folder) as temporary:
        for scan, (points, on_mover) in enumerate(zip(simulated.points, simulated.mover_labels, strict=True)):
            labels = {"mover": on_mover.astype(np.uint8)}
            write_cloud(temporary / f"{scan:0{digits}d}.ply", points, columns=labels)
        write_poses_tum(temporary / TRUTH_FILE, simulated.world_from_scan, simulated.timestamps)
        (temporary / WORLD_FILE).parent.mkdir()
        simulated.world.export(temporary / WORLD_FILE)
        settings = yaml.safe_dump(simulated.settings.as_dict(), sort_keys=False)
        (temporary / SETTINGS_FILE).write_text(settings, encoding="utf-8")


@contextmanager
def _whole_folder(folder: str | Path) -> Iterator[Path]:
    """Yield an empty folder that takes the place of ``folder`` when the block ends well, or else vanishes."""
    final = Path(folder).resolve()
    _check_replaceable(final)
    temporary, earlier = (final.with_name(f".{final.name}.{secrets.token_hex(NAME_BYTES)}") for _ in range(2))
    try:
        temporary.mkdir(parents=True)
    except OSError as error:
        raise type(error)(f"{folder} cannot be written ({error.strerror}): choose another folder") from error
    try:
        yield temporary
        if final.exists():
            final.rename(earlier)
        try:
            temporary.rename(final)
        except OSError:
            if earlier.exists():
                earlier.rename(final)
            raise
        shutil.rmtree(earlier, ignore_errors=True)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _check_replaceable(folder: Path) -> None:
    if not folder.exists():
        return
    if not folder.is_dir():
        raise ValueError(f"{folder} is a file; give the name of a folder for the simulated scans")
    names = [path.name for path in folder.iterdir()]
    strangers = [name for name in names if not OWN_FILES.fullmatch(name)]
    if names and (strangers or SETTINGS_FILE not in names):
        raise ValueError(
            f"{folder} holds other files than a simulation's ({min(strangers or names)}); give a new folder"
        )
