"""A run killed outright at a random moment, gone on with, ends with the same bytes as one that nobody disturbed."""

import hashlib
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

KILLS = 5
LONGEST = 600  # seconds; a run takes well under a minute
PROJECT = Path(__file__).resolve().parent.parent
# What the poses and the points of the map are in; pictures and timings are not compared.
COMPARED = ("poses.npz", "poses_tum.txt", "map.ply", "edges.npz")


def started(*arguments) -> subprocess.Popen:
    """The mapper as its own process."""
    command = [sys.executable, "-m", "train", *map(str, arguments)]
    return subprocess.Popen(command, cwd=PROJECT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def ended(process: subprocess.Popen) -> None:
    """Wait for a run that must end well."""
    _, told = process.communicate(timeout=LONGEST)
    assert process.returncode == 0, told


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
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=LONGEST)
        ended(started(*mapping, "--out", out, "--resume"))
        assert digests(out) == digests(tmp_path / "whole")
