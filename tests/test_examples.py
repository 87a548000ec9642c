"""Every script in examples/ runs on generated data, as a reader would run it, and does what it says."""

import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bbr_layer import read_cloud, write_cloud

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


def two_files(folder: Path) -> tuple[list[str], Callable[[str], None]]:
    """Arguments of register_two_files.py, and a check of what it wrote and printed."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, size=(2, 400))
    bowl = np.stack((x, y, 0.5 * x**2 + 0.3 * y**2 + 0.4 * np.exp(-8 * (x**2 + (y + 0.3) ** 2))), axis=1)
    turn = Rotation.from_rotvec([0.1, -0.15, 0.2]).as_matrix()
    write_cloud(folder / "target.ply", bowl)
    write_cloud(folder / "source.ply", bowl @ turn + 0.1)

    def check(printed: str) -> None:
        np.testing.assert_allclose(read_cloud(folder / "moved.ply").points, bowl, atol=1e-3)
        assert "400 best buddies of 400 points" in printed

    return [str(folder / f"{name}.ply") for name in ("target", "source", "moved")], check


def nothing_needed(folder: Path) -> tuple[list[str], Callable[[str], None]]:
    """No arguments for instead_of_chamfer.py; best buddies end a hundred times nearer."""

    def check(printed: str) -> None:
        chamfer, buddies = (float(aside) for aside in re.findall(r"degrees, ([\d.]+) aside", printed))
        assert buddies < 0.01 and chamfer > 100 * buddies

    return [], check


def few_steps(folder: Path) -> tuple[list[str], Callable[[str], None]]:
    """How many steps learn_what_to_trust.py takes; by then it ends a tenth as far off, and trusts the right points."""

    def check(printed: str) -> None:
        asides = [float(aside) for aside in re.findall(r": ([\d.]+) aside", printed)]
        shares = [float(share) for share in re.findall(r"counts ([\d.]+) of one that did not", printed)]
        assert asides[-1] < 0.1 * asides[0]
        assert shares[0] > 0.8 and shares[-1] < 0.6

    return ["16"], check


def ten_steps(folder: Path) -> tuple[list[str], Callable[[str], None]]:
    """How many steps learn_features.py takes; by then it registers three times as many of the pairs it has not seen."""

    def check(printed: str) -> None:
        found = [int(count) for count in re.findall(r"(\d+) of 40 within", printed)]
        assert found[0] < 13 and found[-1] > 28

    return ["10"], check


# Each example with what prepares its arguments and checks its results; a new example needs a row.
PREPARED = {
    "register_two_files.py": two_files,
    "instead_of_chamfer.py": nothing_needed,
    "learn_what_to_trust.py": few_steps,
    "learn_features.py": ten_steps,
}


def test_every_example_is_run_here():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(PREPARED)


@pytest.mark.parametrize("name", sorted(PREPARED))
def test_example(name, tmp_path, monkeypatch, capsys):
    arguments, check = PREPARED[name](tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    check(capsys.readouterr().out)
