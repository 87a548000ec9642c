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


def test_a_damaged_checkpoint_is_told_wherever_the_damage_is(tmp_path, rng):
    path, files = tmp_path / LAST, WholeCheckpoints()
    files.save_checkpoint({"epoch": 1, "weights": torch.arange(1000.0)}, path)
    whole = path.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"a text"):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"last.ckpt is damaged \(.+\); delete it to train again"):
            files.load_checkpoint(path)
    for place in rng.integers(0, len(whole), 100):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << rng.integers(8)]) + whole[place + 1 :])
        try:
            found = files.load_checkpoint(path)
        except ValueError as error:
            assert "is damaged" in str(error)
        else:
            assert found["epoch"] == 1 and torch.equal(found["weights"], torch.arange(1000.0)), "a wrong answer"
