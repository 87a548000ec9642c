"""A run killed outright at a random moment, gone on with, ends with the same bytes as one that nobody disturbed."""

import hashlib
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from train.checkpoints import LAST

KILLS = 5
LONGEST = 600  # seconds; a run takes well under a minute
PROJECT = Path(__file__).resolve().parent.parent
# What the poses and the points of the map are in; pictures and timings are not compared.
COMPARED = ("poses.npz", "poses_tum.txt", "map.ply", "edges.npz")


def started(*arguments) -> subprocess.Popen:
    """The mapper as its own process."""
    command = [sys.executable, "-m", "train", *map(str, arguments)]
    return subprocess.Popen(command, cwd=PROJECT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen) -> str:
    """Wait for a run that must end well; what it printed."""
    printed, told = process.communicate(timeout=LONGEST)
    assert process.returncode == 0, told
    return printed


def killed(process: subprocess.Popen) -> None:
    """End a run outright."""
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=LONGEST)


def digests(folder: Path) -> list[str]:
    """What the files hold, as numbers to compare."""
    return [hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in COMPARED]


@pytest.mark.slow
def test_a_run_killed_at_random_moments_ends_as_if_undisturbed(tmp_path):
    ended(started("simulate", tmp_path / "world", "--scans", 10, "--beams", 96))
    mapping = ("map", tmp_path / "world", "--epochs", 6)
    begun = time.monotonic()
    ended(started(*mapping, "--out", tmp_path / "whole"))
    duration = time.monotonic() - begun
    moments = random.Random(0)
    for number in range(KILLS):
        out = tmp_path / f"killed{number}"
        process = started(*mapping, "--out", out)
        time.sleep(duration * moments.uniform(0.1, 0.95))
        killed(process)
        ended(started(*mapping, "--out", out, "--resume"))
        assert digests(out) == digests(tmp_path / "whole")


@pytest.mark.slow
def test_a_run_killed_in_its_training_goes_on_from_a_later_epoch(tmp_path):
    ended(started("simulate", tmp_path / "world", "--scans", 10, "--beams", 96))
    poses = tmp_path / "world" / "truth_tum.txt"
    training = ("fit", tmp_path / "world", "--poses", poses, "--epochs", 60, "--out")
    out, begun = tmp_path / "killed", time.monotonic()
    last = out / "checkpoints" / LAST
    process = started(*training, out)
    while epochs_in(last) < 5:
        assert process.poll() is None and time.monotonic() - begun < LONGEST, "no checkpoint while it trains"
        time.sleep(0.05)
    killed(process)
    epochs = epochs_in(last)
    assert epochs >= 5 and not (out / "poses.npz").exists()
    printed = ended(started(*training, out, "--resume"))
    assert int(re.search(r"training (\d+)/60", printed).group(1)) == epochs + 1
    ended(started(*training, tmp_path / "whole"))
    assert digests(out) == digests(tmp_path / "whole")


def epochs_in(checkpoint: Path) -> int:
    """How many epochs of a training it holds; 0 where there is none."""
    return int(torch.load(checkpoint)["epoch"]) + 1 if checkpoint.exists() else 0
