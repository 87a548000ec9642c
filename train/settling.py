"""How far the trajectory goes in each epoch, and the end of the poses' training once it goes nowhere."""

import lightning as L
import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer import RigidMotion
from train.data_module import MappingData
from train.keep_best import mapping_of
from train.schedule import Schedule

# The name under which the change is logged and drawn.
MOVED = "trajectory change"
# Point spacings an epoch below which a trajectory no longer changes, in so many epochs one after the other. Chosen: of
# the default's 40 epochs it saves the last one or two; more would save more, and cost the last digit.
STILL, STILL_EPOCHS = 0.03, 3


class SettleWhenStill(L.Callback):
    """Measure every epoch's change, and begin the settling phase early where poses may move and do not.

    All of it lies in the checkpoints, so that a resumed run ends at the same epoch.

    Parameters
    ----------
    data: what poses are read from.
    """

    def __init__(self, data: MappingData):
        self.data = data
        self.radii = torch.stack([scan.points.double().square().sum(1).mean().sqrt() for scan in data.prepared])
        self.before: RigidMotion | None = None
        self.curve: list[float] = []
        self.still = 0
        self.schedule: Schedule | None = None

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if self.schedule is not None:
            mapping_of(pl_module).schedule = self.schedule
            # A run that had ended early is not to go on up to the epochs that were asked for.
            trainer.should_stop = trainer.current_epoch >= self.schedule.epochs

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.before = mapping_of(pl_module).poses(self.data.every_scan())

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        module, epoch = mapping_of(pl_module), trainer.current_epoch
        assert self.before is not None
        moved = float(trajectory_change(self.before, module.poses(self.data.every_scan()), self.radii))
        self.curve.append(moved)
        module.log(MOVED, moved)
        at_rest = module.schedule.moves(epoch) and moved < STILL * module.model.translation_scale
        self.still = self.still + 1 if at_rest else 0
        # The rates of the next epoch are set already: the one after it is the first that may settle.
        if self.still >= STILL_EPOCHS and epoch + 2 < module.schedule.settles_at:
            self.schedule = module.schedule = module.schedule.settling_at(epoch + 2)
        if epoch + 1 >= module.schedule.epochs:
            trainer.should_stop = True

    def state_dict(self) -> dict[str, object]:
        schedule = None if self.schedule is None else tuple(self.schedule)
        return {"curve": self.curve, "still": self.still, "schedule": schedule}

    def load_state_dict(self, state_dict: dict[str, object]) -> None:
        self.__dict__.update(state_dict)
        self.schedule = None if self.schedule is None else Schedule(*self.schedule)


def trajectory_change(before: RigidMotion, after: RigidMotion, radii: Float[Tensor, " k"]) -> Float[Tensor, ""]:
    """Root mean square of how far scans went, turns counted at their points' own distance; in the data's unit."""
    between = before.inverse() @ after
    turns = torch.linalg.vector_norm(between.rotvec, dim=-1) * radii
    return (between.translation.square().sum(-1) + turns.square()).mean().sqrt()
