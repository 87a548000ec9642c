"""Simulated worlds that are small and made once."""

from functools import cache

from train.simulate import WorldSettings
from train.simulate import simulate as simulate_afresh

SMALL = {2: {"scans": 20, "beams": 48}, 3: {"dimension": 3, "scans": 20, "beams": 24, "rings": 5}}

# Worlds that several tests look at are simulated once.
simulate = cache(simulate_afresh)


def small(dimension=2, **others):
    return WorldSettings(**(SMALL[dimension] | others))
