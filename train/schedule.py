"""When which network learns: the starting map, then map and poses, at last the map of the poses that were kept."""

import math
from typing import NamedTuple

from train.config import TrainingConfig


class Schedule(NamedTuple):
    """Numbers of epochs of the three phases; only in the middle one do poses move."""

    warm_up: int
    joint: int
    settle: int

    @classmethod
    def of(cls, config: TrainingConfig) -> "Schedule":
        """The shares rounded down, so that a short training still has a joint phase."""
        warm_up, settle = int(config.warm_up * config.epochs), int(config.settle * config.epochs)
        return cls(warm_up, config.epochs - warm_up - settle, settle)

    @property
    def epochs(self) -> int:
        """All three together."""
        return sum(self)

    @property
    def settles_at(self) -> int:
        """The first epoch after the poses have stopped moving."""
        return self.warm_up + self.joint

    def moves(self, epoch: int) -> bool:
        """Whether poses may move in that epoch."""
        return self.warm_up <= epoch < self.settles_at

    def settling_at(self, epoch: int) -> "Schedule":
        """The same, but that poses stop moving before ``epoch``."""
        return self._replace(joint=epoch - self.warm_up)

    def progress(self, epoch: int) -> float:
        """Share in [0, 1] of the joint phase that is done when ``epoch`` begins; what terms anneal by."""
        return min(max((epoch - self.warm_up) / max(self.joint - 1, 1), 0.0), 1.0)

    def localisation_rate(self, epoch: int) -> float:
        """Factor of L-Net's learning rate: a half cosine over the joint phase, 0 outside."""
        if not self.moves(epoch):
            return 0.0
        return _cosine((epoch - self.warm_up) / self.joint)

    def occupancy_rate(self, epoch: int) -> float:
        """Factor of M-Net's learning rate: a half cosine over everything."""
        return _cosine(min(epoch / max(self.epochs, 1), 1.0))


def _cosine(fraction: float) -> float:
    return (1 + math.cos(math.pi * fraction)) / 2
