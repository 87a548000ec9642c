"""What every test shares: fixed seeds, a plotting backend without a window, and the folder of real scans."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from differences import shapes_unchecked

# Chosen before anything imports matplotlib: tests draw into files only.
os.environ.setdefault("MPLBACKEND", "Agg")

PROJECT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Gives every test the same torch random numbers, whatever ran before it."""
    torch.manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    """A numpy generator that starts alike in every test."""
    return np.random.default_rng(0)


@pytest.fixture
def as_a_user() -> Iterator[None]:
    """Turns the shape checks off, as they are outside the tests: for a test of what wrong input is told."""
    with shapes_unchecked():
        yield


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real clouds, from BBR_DATA or beside the project; without it the test is skipped."""
    folder = Path(os.environ.get("BBR_DATA", PROJECT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no folder of real clouds at {folder}; set BBR_DATA to have this test run")
    return folder
