"""Shares of a denominator too small for float32 to multiply are 0."""

import numpy as np
import pytest

numba = pytest.importorskip("numba", reason="the compiled sweeps need numba")
from bbr_layer.kernels.cpu_batch import DUAL, GRADIENT  # noqa: E402
from bbr_layer.kernels.cpu_math import BY_S, COOL_RATE, exp_negative, share_of  # noqa: E402
from bbr_layer.kernels.cpu_sweeps import buddy_sums, denominators  # noqa: E402

SMALLEST_NORMAL = 2.0**-126


@numba.njit
def _share(e, inverse):
    return share_of(e, inverse)


@pytest.mark.parametrize(
    ("e", "inverse", "wanted"),
    [
        (0.5, 0.25, 0.125),
        (2.0**-59, 1.0, 2.0**-59),
        (2.0**-61, 1.0, 0.0),
        (SMALLEST_NORMAL, 2.0**-10, 0.0),
        (2.0**-100, 2.0**33, 0.0),  # the constant 1e-10 alone
    ],
)
def test_single_shares_are_kept_or_nothing(e, inverse, wanted):
    assert _share(np.float32(e), np.float32(inverse)) == np.float32(wanted)


def test_double_shares_are_products():
    assert _share(1e-200, 1e-50) == 1e-250


def _tables(n, spread, dtype):
    rng = np.random.default_rng(0)
    sides = np.zeros((8, n), dtype), np.zeros((11, n), dtype)
    for side in sides:
        side[:3] = spread * rng.normal(size=(3, n))
        side[3:5] = 1  # weights and inverse denominators
    constants = np.zeros(9, dtype)
    constants[:2] = 0.04, 1
    return sides, constants, (np.zeros((16, n)), np.zeros((12, n)))


@pytest.mark.parametrize("spread", [1.0, 15.0, 40.0])
def test_sums_of_far_pairs_are_those_in_float64(spread):
    found = []
    for dtype in (np.float32, np.float64):
        sides, constants, out = _tables(300, spread, dtype)
        denominators(sides, None, out, constants, None)
        sides[0][4], sides[1][4] = 1 / (out[0][0] + 1e-10), 1 / (out[1][0] + 1e-10)
        out[0][:], out[1][:] = 0, 0
        buddy_sums(sides, None, out, constants, None)
        found.append(np.concatenate((out[0][:2].ravel(), out[1][:2].ravel())))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("sweeps", [GRADIENT, DUAL], ids=["gradient", "rates"])
@pytest.mark.parametrize("part", [1, 2])
def test_no_sweep_multiplies_shares_below_the_smallest_number(sweeps, part):
    """One pair 46 temperatures apart: e is 1e-20, and its square would be 1e-40."""
    sides, constants, out = _tables(1, 0.0, np.float32)
    sides[1][0] = 46.0
    sides[1][8] = 1.0  # the column moves
    constants[BY_S] = -1.0
    constants[COOL_RATE] = 1.0
    sweeps.parts[part](sides, None, out, constants, None)
    assert not out[0].any() and not out[1].any()


@numba.njit
def _exponential(x):
    return exp_negative(x)


def test_the_smallest_exponential_over_a_thousand_is_a_normal_number():
    assert SMALLEST_NORMAL <= _exponential(np.float32(-1e9)) / 1024 < 2.0**-100
