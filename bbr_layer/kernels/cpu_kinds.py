"""The three sweeps of a loss and of its rates, whatever stands beside the points: nothing, normals, or features.

Which of two functions it is, is known by type.
"""

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from bbr_layer.kernels.cpu_apart import Apart, Pulled, is_apart
from bbr_layer.kernels.cpu_dual import buddy_sum_rates, denominator_rates
from bbr_layer.kernels.cpu_dual_planes import force_rates
from bbr_layer.kernels.cpu_feature_rates import (
    feature_buddy_sum_rates,
    feature_denominator_rates,
    feature_force_rates,
)
from bbr_layer.kernels.cpu_features import feature_buddy_sums, feature_denominators, feature_forces
from bbr_layer.kernels.cpu_forces import forces
from bbr_layer.kernels.cpu_sweeps import buddy_sums, denominators

Sweep = Callable[..., None]


def either(without: Sweep, by_features: Sweep) -> Sweep:
    """One of two sweeps, from Python and from compiled code."""

    def sweep(sides: Any, beside: Any, out: Any, constants: Any, kept: Any) -> None:
        chosen = by_features if isinstance(beside, Apart | Pulled) else without
        chosen(sides, beside, out, constants, kept)

    @overload(sweep)
    def _compiled(sides, beside, out, constants, kept):  # type: ignore[no-untyped-def]
        chosen = by_features if is_apart(beside) else without
        return lambda sides, beside, out, constants, kept: chosen(sides, beside, out, constants, kept)

    return sweep


GRADIENT_SWEEPS = (
    either(denominators, feature_denominators),
    either(buddy_sums, feature_buddy_sums),
    either(forces, feature_forces),
)
DUAL_SWEEPS = (
    either(denominator_rates, feature_denominator_rates),
    either(buddy_sum_rates, feature_buddy_sum_rates),
    either(force_rates, feature_force_rates),
)
