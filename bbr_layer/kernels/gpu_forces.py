"""The last sweep in Triton: forces on points, torques on normals, sums for temperature and rounding; and their rates.

Arguments as in ``gpu_sweeps``.
"""

from typing import no_type_check

import triton
import triton.language as tl

from bbr_layer.kernels.gpu_pairs import (
    CHANNELS,
    OTHER,
    OTHER_LENGTH,
    OWN,
    PLANES,
    RATES,
    numbers_of,
    place_of,
    points_at,
    tile,
    tile_rates,
)
from bbr_layer.kernels.gpu_sweeps import own_points, own_sums

# Channels of ``out``: force (three), torque (three), sums for temperature and for rounding; then their rates.
TORQUE = tl.constexpr(3)
HEAT = tl.constexpr(6)
ROUND = tl.constexpr(7)
FORCE_SUMS = tl.constexpr(8)


@triton.jit
@no_type_check
def slopes(own, other, item, at):
    """Own and other factor of the buddies, buddies, and the derivatives of the loss by -D / alpha and by D."""
    weight, inverse, share = own[4][1], own[4][2], own[4][3]
    other_weight, other_inverse, other_share = other[4][1], other[4][2], other[4][3]
    e, distance = at[0], at[1]
    cool, by_S, by_M = item[2]
    r, c = e * inverse, e * other_inverse
    buddies = r * c * (weight * other_weight)
    by_logit = 2.0 * (by_S + by_M * distance) * buddies - r * share - c * other_share
    return r, c, buddies, by_logit, by_M * buddies - by_logit * cool


@triton.jit
@no_type_check
def slope_rates(factors, item, distance, now, rates):
    """Rates of change of the two derivatives.

    ``factors`` are (own[4], other[4]), ``now`` what ``slopes`` answered, ``rates`` what ``tile_rates`` answered.
    """
    share, inverse_rate, share_rate = factors[0][3], factors[0][4], factors[0][5]
    other_share, other_inverse_rate, other_share_rate = factors[1][3], factors[1][4], factors[1][5]
    cool, by_S, by_M = item[2]
    cool_rate, by_S_rate, by_M_rate = item[3]
    r, c, buddies, by_logit = now[0], now[1], now[2], now[3]
    r_change, c_change = rates[0] - inverse_rate, rates[0] - other_inverse_rate
    buddies_rate = buddies * (r_change + c_change)
    value_rate = by_S_rate + by_M_rate * distance + by_M * rates[1]
    by_logit_rate = 2.0 * (value_rate * buddies + (by_S + by_M * distance) * buddies_rate)
    by_logit_rate -= r * (r_change * share + share_rate) + c * (c_change * other_share + other_share_rate)
    by_distance_rate = by_M_rate * buddies + by_M * buddies_rate - (by_logit_rate - by_logit * cool_rate) * cool
    return by_logit_rate, by_distance_rate


@triton.jit
@no_type_check
def added(total, factor, vector):
    """A vector of sums with a tile's sum of ``factor vector`` added."""
    return (
        total[0] + tl.sum(factor * vector[0], 1),
        total[1] + tl.sum(factor * vector[1], 1),
        total[2] + tl.sum(factor * vector[2], 1),
    )


@triton.jit
@no_type_check
def store_sums(place, step, vectors, scalars, KIND: tl.constexpr):
    """Write force and torque, and the sums for temperature and rounding."""
    for k in tl.static_range(3):
        tl.store(place + k * step, vectors[0][k])
        if PLANES & KIND:
            tl.store(place + (TORQUE + k) * step, vectors[1][k])
    tl.store(place + HEAT * step, scalars[0])
    tl.store(place + ROUND * step, scalars[1])


@triton.jit
@no_type_check
def forces(own, other, numbers, out, KIND: tl.constexpr):
    """Derivatives of the loss by own points and normals, and what each own point adds to temperature and rounding."""
    item, mine = numbers_of(numbers, own), own_points(own, numbers, KIND)
    first, length = place_of(other, numbers, OTHER_LENGTH, CHANNELS)
    none = tl.zeros([OWN], tl.float64)
    force, torque, heat, round = (none, none, none), (none, none, none), none, none
    force_rate, torque_rate, heat_rate, round_rate = (none, none, none), (none, none, none), none, none
    for start in range(0, length, OTHER):
        theirs = points_at(first + start + tl.arange(0, OTHER)[None, :], length, KIND)
        at = tile(mine, theirs, item, KIND)
        distance, over, offset, along, residual = at[1], at[2], at[3], at[4], at[5]
        now = slopes(mine, theirs, item, at)
        spread = now[4] * over
        force = added(force, spread * residual, along)
        if PLANES & KIND:
            torque = added(torque, spread * residual, offset)
        heat += tl.sum(now[3] * distance, 1)
        round += tl.sum(spread, 1)
        if RATES & KIND:
            rates = tile_rates(mine, theirs, item, at, KIND)
            slope_rate = slope_rates((mine[4], theirs[4]), item, distance, now, rates)
            spread_rate = (slope_rate[1] - spread * rates[1]) * over
            factor, factor_rate = spread * residual, spread_rate * residual + spread * rates[4]
            force_rate = added(added(force_rate, factor_rate, along), factor, rates[3])
            if PLANES & KIND:
                torque_rate = added(added(torque_rate, factor_rate, offset), factor, rates[2])
            heat_rate += tl.sum(slope_rate[0] * distance + now[3] * rates[1], 1)
            round_rate += tl.sum(spread_rate, 1)
    if RATES & KIND:
        place, step = own_sums(out, numbers, FORCE_SUMS * 2)
        store_sums(place + FORCE_SUMS * step, step, (force_rate, torque_rate), (heat_rate, round_rate), KIND)
    else:
        place, step = own_sums(out, numbers, FORCE_SUMS)
    store_sums(place, step, (force, torque), (heat, round), KIND)
