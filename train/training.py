"""Training the map with Lightning: from scans, edges and starting poses to corrected poses and an occupancy network."""

import math
import signal
import warnings
from dataclasses import dataclass
from pathlib import Path

import lightning as L
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from bbr_layer import RigidMotion
from train.alignment import Alignment
from train.checkpoints import LAST, KeepLast, WholeCheckpoints
from train.config import MapConfig
from train.data_module import MappingData
from train.keep_best import MARGIN, KeepBest, ReportProgress
from train.mapping_module import MappingModule, build_module
from train.pose_graph import Edges
from train.run_folder import CHECKPOINTS, LOGS
from train.scans import Progress, ScanSet, silent
from train.settling import MOVED, SettleWhenStill
from train.surface_map import MapScore, SurfaceMap

LEAF_SPEC = r"`isinstance\(treespec, LeafSpec\)` is deprecated"


class Stopped(SystemExit):
    """A signal ended the training before there was a map; ``code`` is what a shell expects: 128 and its number.

    Parameters
    ----------
    number: SIGTERM or SIGINT.
    """

    def __init__(self, number: signal.Signals):
        super().__init__(128 + number)
        self.number = number

    def __str__(self) -> str:
        return f"{self.number.name} stopped the training before there was a map; --resume goes on from its last epoch"


@dataclass(frozen=True)
class Trained:
    """What the training found.

    Parameters
    ----------
    world_from_scan: ``(k, ...)`` of the epoch that was kept.
    module: its M-Net knows the map of these poses.
    curves: per epoch: "total", "occupancy", "registration", "trajectory change"; and "alignment", which begins with the
        starting map.
    kept_epoch: 0 is the starting map, adjusted or not.
    """

    world_from_scan: RigidMotion
    module: MappingModule
    curves: dict[str, list[float]]
    kept_epoch: int


def train_map(
    scans: ScanSet,
    edges: Edges,
    start: RigidMotion,
    config: MapConfig,
    *,
    folder: Path | None = None,
    progress: Progress = silent,
    fast_dev_run: bool = False,
) -> Trained:
    """Correct the poses so that one occupancy map explains all scans, and never end worse than the start by default.

    Parameters
    ----------
    scans, edges: what is to be aligned.
    start: ``world_from_scan (k, ...)``; the first stays.
    config: settings.
    folder: gets ``checkpoints/`` and ``logs/``; a checkpoint found there is gone on from. None: nothing is written.
    progress: told each epoch.
    fast_dev_run: one step only, as Lightning has it; nothing is read or written.

    Raises
    ------
    Stopped: a signal came; the checkpoint of the last whole epoch is there.
    """
    folder = None if fast_dev_run else folder
    data = MappingData(scans, edges, start, config=config.training, seed=config.seed)
    module = build_module(data, config.training, seed=config.seed)
    if not config.training.epochs:
        return Trained(module.poses(data.every_scan()), module, {}, 0)
    score = MapScore(Alignment(data.prepared, edges), SurfaceMap(scans, data.prepared, start.matrix.double().numpy()))
    if config.training.adjust:
        data.start = score.adjusted(data.start, progress)
    margin = MARGIN if config.training.keep == "best" else -math.inf
    best, settling = KeepBest(score, data, margin), SettleWhenStill(data)
    trainer = L.Trainer(
        accelerator=config.device,
        devices=1,
        max_epochs=config.training.epochs,
        callbacks=[settling, *_callbacks(best, folder, progress)],
        logger=_loggers(folder),
        reload_dataloaders_every_n_epochs=1,
        log_every_n_steps=1,
        fast_dev_run=fast_dev_run,
        enable_checkpointing=folder is not None,
        plugins=[WholeCheckpoints()],
        # Progress is reported through ``progress``, for the whole of the run in one place.
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    _fit(trainer, module, data, folder)
    best.restore(module)
    curves = best.curves | {MOVED: settling.curve}
    return Trained(module.poses(data.every_scan()), module, curves, best.kept_epoch)


def _fit(trainer: L.Trainer, module: MappingModule, data: MappingData, folder: Path | None) -> None:
    """Train, from the folder's checkpoint on if there is one.

    Raises
    ------
    Stopped: a signal came.
    """
    checkpoint = None if folder is None else folder / CHECKPOINTS / LAST
    found = checkpoint is not None and checkpoint.is_file()
    with warnings.catch_warnings():
        # Lightning 2.6 walks trees by a class that torch 2.13 renames; nothing for a user to act on.
        warnings.filterwarnings("ignore", message=LEAF_SPEC, category=FutureWarning)
        try:
            trainer.fit(module, data, ckpt_path=checkpoint if found else None)
        except SystemExit as error:
            # Lightning makes one of both signals, with codes 0 and 1.
            raise Stopped(signal.SIGTERM if trainer.received_sigterm else signal.SIGINT) from error
    if trainer.received_sigterm:
        raise Stopped(signal.SIGTERM)


def _callbacks(best: KeepBest, folder: Path | None, progress: Progress) -> list[L.Callback]:
    callbacks: list[L.Callback] = [best, ReportProgress(progress)]
    if folder is not None:
        callbacks.append(KeepLast(folder / CHECKPOINTS / LAST))
    return callbacks


def _loggers(folder: Path | None) -> list[Logger]:
    if folder is None:
        return []
    logs = str(folder / LOGS)
    return [CSVLogger(logs, name="csv"), TensorBoardLogger(logs, name="tensorboard")]
