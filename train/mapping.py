"""The main job: registered edges, a starting map, a trained one, and the files that hold it."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from bbr_layer import RigidMotion
from train.config import EdgeConfig, MapConfig
from train.edge_files import load_edges, save_edges
from train.edges import register_edges
from train.outputs import MapResult, write_outputs
from train.pose_graph import Edges
from train.run_folder import EDGES, RunFolder
from train.scans import Progress, ScanSet, silent
from train.training import train_map

# Finds the edges of scans, and poses that they agree on.
Registrar = Callable[[ScanSet, EdgeConfig, Progress], tuple[Edges, RigidMotion]]


@dataclass(frozen=True)
class Mapped:
    """What ``map_scans`` made.

    Parameters
    ----------
    result: as it was written.
    start: ``world_from_scan (k, ...)`` of the edges' map, before the training.
    kept_epoch: whose poses they are; 0 is the edges' map, adjusted or not.
    """

    result: MapResult
    start: RigidMotion
    kept_epoch: int


def map_scans(
    run: RunFolder,
    scans: ScanSet,
    config: MapConfig,
    *,
    register: Registrar = register_edges,
    unit: str = "units",
    progress: Progress = silent,
) -> Mapped:
    """From scans to a folder with their trajectory and map; killed at any point, it goes on from what is there.

    Parameters
    ----------
    run: the folder, as ``open_run`` made it ready for these scans and settings.
    scans, config: what is to be mapped, and how.
    register: finds the edges, where the folder has none.
    unit: name of the data's unit, for the pictures.
    progress: told what is done.

    Raises
    ------
    ValueError: a file in the folder is damaged.
    OSError: the folder cannot be written.
    """
    timings: dict[str, float] = {}
    with timed(timings, "edges"):
        edges, start = registered(run, scans, config, register=register, progress=progress)
    with timed(timings, "training"):
        trained = train_map(scans, edges, start, config, folder=run.path, progress=progress)
    result = MapResult(
        scans=scans,
        world_from_scan=trained.world_from_scan.matrix.numpy(),
        edges=edges,
        occupancy=trained.module.occupied if config.training.epochs else None,
        losses=trained.curves,
        settings=config.model_dump(mode="json"),
        timings=timings,
        unit=unit,
    )
    write_outputs(run.path, result, progress)
    return Mapped(result, start, trained.kept_epoch)


def registered(
    run: RunFolder, scans: ScanSet, config: MapConfig, *, register: Registrar, progress: Progress
) -> tuple[Edges, RigidMotion]:
    """The edges in the folder of the run, or else new ones, which are put there."""
    path = run.path / EDGES
    if not run.registered:
        save_edges(path, *register(scans, config.edges, progress), scans)
    # Read back even when new: an unbroken run and a resumed one then start from the same bits.
    return load_edges(path, scans)


@contextmanager
def timed(timings: dict[str, float], stage: str) -> Iterator[None]:
    """Note under ``stage`` how many seconds the block took."""
    begin = time.perf_counter()
    yield
    timings[stage] = time.perf_counter() - begin
