"""The poses that align the scans best, the starting ones included: what the training is allowed to answer."""

import copy
from collections.abc import Callable

import lightning as L
from torch import Tensor

from bbr_layer import RigidMotion
from train.data_module import MappingData
from train.mapping_module import MappingModule
from train.scans import Progress

# The name under which the score is logged and kept.
SCORE = "alignment"
# By how much a later epoch must be better by default. The held-out points are a sample: between poses that are equally
# far from the truth the score differs by about 1e-4.
MARGIN = 5e-4


class KeepBest(L.Callback):
    """Score the poses before the training and after every epoch, and go back to the best ones for the settling phase.

    Epoch 0 is the starting map, epoch e the poses after e epochs. A later epoch must be better
    by ``margin``. All of it lies in the checkpoints, so that a resumed run has the same history and best poses.

    Parameters
    ----------
    alignment: the score, lower is better.
    data: what poses are read from.
    margin: by how much a later epoch must be better. Default ``MARGIN``; minus infinity: the last epoch is kept.
    """

    def __init__(self, alignment: Callable[[RigidMotion], float], data: MappingData, margin: float = MARGIN):
        self.alignment, self.data, self.margin = alignment, data, margin
        self.kept_epoch = 0
        self.kept: dict[str, Tensor] | None = None
        self.curves: dict[str, list[float]] = {}

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if self.kept is None:
            module = mapping_of(pl_module)
            self.curves = {SCORE: [self.alignment(module.poses(self.data.every_scan()))]}
            self.kept = copy.deepcopy(module.model.localisation.state_dict())

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.current_epoch == mapping_of(pl_module).schedule.settles_at:
            self.restore(mapping_of(pl_module))

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        module, epoch = mapping_of(pl_module), trainer.current_epoch
        score = self.alignment(module.poses(self.data.every_scan()))
        if score < self.curves[SCORE][self.kept_epoch] - self.margin:
            self.kept_epoch = epoch + 1
            self.kept = copy.deepcopy(module.model.localisation.state_dict())
        self.curves[SCORE].append(score)
        module.log(SCORE, score)
        for name, value in trainer.callback_metrics.items():
            if name.startswith("loss/"):
                self.curves.setdefault(name.removeprefix("loss/"), []).append(float(value))

    def restore(self, module: MappingModule) -> None:
        """Put the best L-Net back."""
        if self.kept is not None:
            module.model.localisation.load_state_dict(self.kept)

    def state_dict(self) -> dict[str, object]:
        return {"kept_epoch": self.kept_epoch, "kept": self.kept, "curves": self.curves}

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        self.__dict__.update(state_dict)


class ReportProgress(L.Callback):
    """Tells ``progress`` every finished epoch."""

    def __init__(self, progress: Progress):
        self.progress = progress

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.progress("training", trainer.current_epoch + 1, mapping_of(pl_module).schedule.epochs)


def mapping_of(module: L.LightningModule) -> MappingModule:
    """The module, which must be the mapper.

    Raises
    ------
    TypeError: it is another.
    """
    if not isinstance(module, MappingModule):
        raise TypeError(f"the trained module is a {type(module).__name__}; these callbacks need a MappingModule")
    return module
