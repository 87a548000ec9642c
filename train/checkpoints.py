"""The checkpoint that a killed training goes on from: one file, replaced whole after every epoch."""

import io
import zipfile
from collections.abc import Callable
from pathlib import Path

import lightning as L
import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning.pytorch.callbacks import Checkpoint

from bbr_layer import atomic_write
from train.damage import DAMAGED

# The file in the folder of checkpoints.
LAST = "last.ckpt"


class KeepLast(Checkpoint):
    """Writes ``path`` after every epoch, once all other callbacks have done their part of it.

    Lightning's own ``ModelCheckpoint`` writes its last one when the training ends, which a killed training never does.

    Parameters
    ----------
    path: the file; the best poses lie in it too, in KeepBest's part.
    """

    def __init__(self, path: Path):
        self.path = path

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        trainer.save_checkpoint(self.path)


class WholeCheckpoints(TorchCheckpointIO):
    """Replaces a file whole or not at all.

    Lightning writes into the system's folder of temporary files, and copies where that is another file system: killed
    in the middle of it, half a file would stand where a whole one stood.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, object], path: str | Path, storage_options: object | None = None
    ) -> None:
        """Raises OSError where the file cannot be written; the one before stays then."""
        # By way of memory: torch.save tells a full disk by a RuntimeError.
        whole = io.BytesIO()
        torch.save(checkpoint, whole)
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary:
            temporary.write_bytes(whole.getbuffer())

    def load_checkpoint(
        self,
        path: str | Path,
        map_location: Callable | None = lambda storage, place: storage,
        weights_only: bool | None = None,
    ) -> dict[str, object]:
        """Lightning's own, of a file whose every byte is as it was written.

        Raises
        ------
        ValueError: the file is damaged.
        """
        try:
            with zipfile.ZipFile(path) as archive:
                if (part := archive.testzip()) is not None:
                    raise zipfile.BadZipFile(f"bad checksum of {part}")
            return super().load_checkpoint(path, map_location, weights_only)
        except DAMAGED as error:
            raise ValueError(f"{path} is damaged ({error}); delete it to train again on the same edges") from error
