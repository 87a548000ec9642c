"""The benchmark of the registration terms: its starts, what it measures again, and its table."""

import numpy as np
from small_worlds import small_world

from benchmarks import mapping_starts
from benchmarks.mapping_starts import Way, measured_terms, shaken, terms_table


def test_a_seed_shakes_all_poses_but_the_first():
    scans = small_world()
    first, again, other = (shaken(scans, seed).matrix.numpy() for seed in (0, 0, 1))
    np.testing.assert_allclose(first[0], scans.truth[0], atol=1e-12)
    np.testing.assert_array_equal(first, again)
    assert (np.abs(first[1:] - other[1:]).max((1, 2)) > 1e-4).all()
    assert (np.abs(first[1:] - scans.truth[1:]).max((1, 2)) > 1e-4).all()


def test_only_what_is_lacking_is_measured(monkeypatch):
    monkeypatch.setattr(mapping_starts, "trained", lambda way, term, seed: {"made": (way, term, seed)})
    found = dict(measured_terms(["F"], {"direct": 2, "network": 1}, {"direct, F, seed 0": {}}))
    assert found == {
        "direct, F, seed 1": {"made": (Way("direct", False), "F", 1)},
        "direct, adjusted, F, seed 0": {"made": (Way("direct", True), "F", 0)},
        "direct, adjusted, F, seed 1": {"made": (Way("direct", True), "F", 1)},
        "network, F, seed 0": {"made": (Way("network", False), "F", 0)},
    }


def test_the_table_has_medians_and_ranges_of_each_way():
    numbers = {0: (3.0, 31), 1: (1.0, 30), 2: (1.5, 32)}
    results = {
        f"direct, F, seed {seed}": {"start": 6.0 + seed, "error": error, "kept": kept, "CPU seconds": 10.0 * seed}
        for seed, (error, kept) in numbers.items()
    } | {"direct, adjusted, F, seed 0": {"start": 6.0, "error": 0.1, "kept": 0, "CPU seconds": 9.0}}
    text = terms_table(results)
    assert "| F | direct | 3 | 1.5 | 1 to 3 | 30 to 32 | 10 |" in text
    assert "| F | direct, adjusted | 1 | 0.1 | 0.1 to 0.1 | 0 to 0 | 9 |" in text
    assert "6.00 to 8.00 px off" in text and "network |" not in text
