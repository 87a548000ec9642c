"""What of a run lies in its folder, and how much of it goes for the next one."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

from bbr_layer import atomic_write
from train.config import MapConfig
from train.scans import ScanSet

EDGES = "edges.npz"
CHECKPOINTS, LOGS = "checkpoints", "logs"
# What the files in a folder were made from.
STATE = Path(CHECKPOINTS, "run.json")
# Written when the map is there; whoever finds it finds a map.
MAP = "poses.npz"
# What a run without ``resume`` takes away.
REPLACED = (EDGES, CHECKPOINTS, LOGS)
# The files that show a map, the one that tells of it first. The settings, config.yaml, are not among them: a run may
# have been given the very file.
MAP_FILES = (
    *(MAP, "poses_tum.txt", "poses_kitti.txt", "map.ply", "movers.ply", "map.html", "metrics.json"),
    *("trajectory.png", "map.png", "losses.png", "occupancy.png", "occupancy.yaml", "occupancy_network.png"),
)


@dataclass(frozen=True)
class RunFolder:
    """A folder that a run writes to.

    Parameters
    ----------
    path: the folder.
    registered: its ``edges.npz`` belongs to this run.
    begun: its checkpoint, if there is one, belongs to this run.
    """

    path: Path
    registered: bool
    begun: bool


def open_run(
    path: Path,
    scans: ScanSet,
    config: MapConfig,
    *,
    origin: str = "registered",
    resume: bool = False,
    overwrite: bool = False,
) -> RunFolder:
    """Make ready the folder of a run: keep what is to be gone on from, remove what belongs to another run.

    With ``resume``, edges stay when they belong to the same scans and edge settings, and a checkpoint when the
    training settings are the same too; so other training settings begin a new training on the same edges. A map of
    other scans or settings is removed.

    Parameters
    ----------
    path: the folder; made if it is missing.
    scans, config: what the run maps, and how.
    origin: where its edges come from.
    resume: keep what fits. overwrite: replace a map made from something else.

    Raises
    ------
    ValueError: the folder holds a map from other scans or settings, and neither ``resume`` nor ``overwrite`` is set; or
        files that no run is known to have left and that this one would delete, and ``overwrite`` is not set.
    OSError: the folder cannot be written.
    """
    ours = (path / STATE).exists()
    if not (ours or overwrite):
        _refuse_files_of_others(path)
    wanted, earlier = _state(scans, config, origin), _read_state(path)
    same = {key: earlier.get(key) == value for key, value in wanted.items()}
    if (path / MAP).exists() and not all(same.values()) and not (resume or overwrite):
        other = "unknown settings" if not earlier else f"other {' and '.join(k for k in same if not same[k])}"
        raise ValueError(
            f"{path} holds a map made from {other}: give another folder, --overwrite, or --resume to keep what fits"
        )
    registered = resume and same["scans"] and same["edges"]
    begun = registered and same["training"]
    _make_folder(path / CHECKPOINTS)
    if (ours or overwrite) and not all(same.values()):
        # A map of other scans or settings must not stand beside the state of this run.
        for name in MAP_FILES:
            (path / name).unlink(missing_ok=True)
    if not registered:
        (path / EDGES).unlink(missing_ok=True)
    if not begun:
        _forget_training(path)
    with atomic_write(path / STATE) as temporary:
        temporary.write_text(json.dumps(wanted, indent=2), encoding="utf-8")
    return RunFolder(path, registered and (path / EDGES).is_file(), begun)


def _refuse_files_of_others(path: Path) -> None:
    """A folder without the state of a run is not ours to clear; empty folders are nothing to lose."""
    found = [name for name in (*REPLACED, MAP) if (path / name).is_file() or any((path / name).glob("*"))]
    if found:
        raise ValueError(
            f"{path} holds {', '.join(found)} but no {STATE} that tells what run left that: give another folder, or "
            "--overwrite to delete it"
        )


def _forget_training(path: Path) -> None:
    """Remove checkpoints and logs; the state stays until the next replaces it, and tells that the folder is ours."""
    shutil.rmtree(path / LOGS, ignore_errors=True)
    for found in (path / CHECKPOINTS).iterdir():
        if found.is_dir():
            shutil.rmtree(found)
        elif found != path / STATE:
            found.unlink()


def _state(scans: ScanSet, config: MapConfig, origin: str) -> dict[str, object]:
    """What each part of a run depends on; the device is none of it."""
    settings = config.model_dump(mode="json")
    return {
        "scans": scans.fingerprint(),
        "edges": {"origin": origin, **settings["edges"]},
        "training": {"seed": config.seed, **settings["training"]},
    }


def _read_state(path: Path) -> dict[str, object]:
    try:
        state = json.loads((path / STATE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return state if isinstance(state, dict) else {}


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(f"{path.parent} cannot be written ({error.strerror}): choose another folder") from error
