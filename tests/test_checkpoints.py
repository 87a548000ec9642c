"""Checkpoints are replaced whole or not at all."""

from pathlib import Path

import pytest
import torch

from train.checkpoints import LAST, WholeCheckpoints


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(tmp_path, monkeypatch):
    path, files = tmp_path / "checkpoints" / LAST, WholeCheckpoints()
    files.save_checkpoint({"epoch": 1}, path)
    write = Path.write_bytes

    def half(target, data):
        assert files.load_checkpoint(path)["epoch"] == 1, "the old one is there while the new one is written"
        write(target, bytes(data)[: len(data) // 2])
        raise OSError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", half)
        with pytest.raises(OSError, match="disk full"):
            files.save_checkpoint({"epoch": 2, "weights": torch.zeros(1000)}, path)
    assert [found.name for found in path.parent.iterdir()] == [LAST]
    assert files.load_checkpoint(path) == {"epoch": 1}
    files.save_checkpoint({"epoch": 3}, path)
    assert files.load_checkpoint(path) == {"epoch": 3}
