"""The mapper as Lightning trains it."""

from collections.abc import Callable, Iterable

import lightning as L
import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch.utilities.types import OptimizerLRScheduler
from torch import Tensor

from bbr_layer import RigidMotion
from models import (
    DeepMapping,
    FreePoses,
    LNet,
    Localisation,
    MNet,
    ScanBatch,
    corrected_poses,
    registration_term,
)
from train.config import TERMS, TrainingConfig
from train.data_module import MappingData
from train.schedule import Schedule

# L-Net sees lengths as shares of this quantile of the ranges; few returns are much farther.
FAR = 0.95
# Places judged at once when the map is drawn.
PLACES_PER_CHUNK = 100_000
# Apart in a seed sequence: the free-space samples of one step draw on nothing that the scans' points draw on.
FREE_SPACE_STREAM = 1


class MappingModule(L.LightningModule):
    """DeepMapping with its optimiser: a learning rate for the poses and one for M-Net, each on its own schedule.

    Parameters
    ----------
    model: networks and registration term.
    config: rates and epochs.
    seed: of the free-space samples; those of a step depend on the seed, the epoch and the step alone.
    """

    def __init__(self, model: DeepMapping, config: TrainingConfig, *, seed: int):
        super().__init__()
        self.model, self.config, self.seed = model, config, seed
        self.schedule = Schedule.of(config)

    def on_train_epoch_start(self) -> None:
        self.model.set_progress(self.schedule.progress(self.current_epoch))

    def training_step(self, batch: ScanBatch, batch_idx: int) -> Tensor:
        sequence = np.random.SeedSequence((self.seed, self.current_epoch, batch_idx, FREE_SPACE_STREAM))
        generator = torch.Generator(self.device).manual_seed(int(sequence.generate_state(1)[0]))
        losses = self.model(batch, generator).losses
        for name, value in losses.items():
            self.log(f"loss/{name}", value.float(), on_step=False, on_epoch=True, batch_size=1)
        return losses["total"]

    def configure_optimizers(self) -> OptimizerLRScheduler:
        localisation = list(self.model.localisation.parameters())
        others = [*self.model.occupancy.parameters(), *self.model.registration_term.parameters()]
        optimiser = torch.optim.Adam(
            [
                {"params": localisation, "lr": self.config.first_localisation_rate},
                {"params": others, "lr": self.config.occupancy_rate},
            ]
        )
        # Plain functions: a checkpoint would take the attributes of anything else along.
        rates: list[Callable[[int], float]] = [
            lambda epoch: self.schedule.localisation_rate(epoch),
            lambda epoch: self.schedule.occupancy_rate(epoch),
        ]
        scheduler = torch.optim.lr_scheduler.LambdaLR(optimiser, rates)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": scheduler, "interval": "epoch"}}

    @torch.no_grad()
    def poses(self, batches: Iterable[ScanBatch]) -> RigidMotion:
        """Corrected ``world_from_scan`` of the scans of all batches, ``(k, ...)`` float64 on the CPU."""
        found = []
        for batch in batches:
            here = self.transfer_batch_to_device(batch, self.device, 0)
            correction = self.model.localisation.corrections(here)
            found.append(corrected_poses(here, correction, self.model.translation_scale).to("cpu"))
        return RigidMotion(torch.cat([m.rotation for m in found]), torch.cat([m.translation for m in found]))

    @torch.no_grad()
    def occupied(self, places: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
        """Probability that each place in the world is occupied, by M-Net."""
        chunks = torch.from_numpy(np.asarray(places, dtype=np.float64)).split(PLACES_PER_CHUNK)
        answers = [self.model.occupancy(chunk.to(self.device)).sigmoid().cpu() for chunk in chunks]
        return torch.cat(answers).double().numpy() if answers else np.zeros(0)


def build_module(data: MappingData, config: TrainingConfig, *, seed: int) -> MappingModule:
    """Networks of the size of the scans and of the starting map, their first weights drawn from ``seed``.

    The unit of length of corrections is the scans' median point spacing: what a starting map of registered edges may be
    off.
    """
    points = torch.cat([scan.points[scan.trained] for scan in data.prepared])
    far = torch.quantile(_thinned(torch.linalg.vector_norm(points, dim=1)), FAR).item() or 1.0
    spacing = float(np.median([scan.spacing for scan in data.prepared])) or far
    name, settings = TERMS[config.term]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        localisation = _localisation(len(data.prepared), points.shape[1], (far, spacing), config)
        occupancy = MNet.paper(points.shape[1]) if config.size == "paper" else MNet(points.shape[1])
    model = DeepMapping(
        localisation,
        occupancy,
        registration_term(name, settings),
        free_samples=config.free_samples,
        occupancy_weight=config.occupancy_weight,
        registration_weight=config.registration_weight,
        translation_scale=spacing,
    )
    blocks = [data.start.item(batch.index)(batch.points)[batch.mask] for batch in data.every_scan()]
    occupancy.fit_bounds(torch.cat(blocks))
    return MappingModule(model, config, seed=seed)


def _localisation(count: int, dimension: int, lengths: tuple[float, float], config: TrainingConfig) -> Localisation:
    """What corrects poses; ``lengths`` are how far the scans reach and their point spacing."""
    far, spacing = lengths
    if config.localisation == "direct":
        return FreePoses(count, dimension, turn=spacing / far)
    if config.size == "paper":
        return LNet.paper(dimension, scale=far)
    by_dimension = "ordered" if dimension == 2 else "unordered"
    encoder = by_dimension if config.encoder == "auto" else config.encoder
    return LNet(dimension, encoder, scale=far)


def _thinned(values: Tensor) -> Tensor:
    # torch.quantile refuses more than 2^24 numbers; 2^20 give it three digits to spare.
    return values[:: -(-len(values) // 2**20)]
