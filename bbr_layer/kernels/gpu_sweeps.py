"""The first two sweeps in Triton: denominators of Eq. 4, and sums of buddies; with rates of change if asked.

Arguments of all sweeps: ``own`` and ``other`` clouds, ``numbers`` of the items, ``out`` ``(batch, channels, own
length)`` float64, and what to compile for; see ``gpu_pairs``. The grid is (blocks of own points, batch). A tile is
summed in the precision of the points, the tiles are added up in float64. Rates of change stand behind all the sums.
"""

from typing import no_type_check

import triton
import triton.language as tl

from bbr_layer.kernels.gpu_pairs import (
    CHANNELS,
    OTHER,
    OTHER_LENGTH,
    OWN,
    OWN_LENGTH,
    RATES,
    numbers_of,
    place_of,
    points_at,
    tile,
    tile_rates,
)

# Sums per point, without rates: of exp(-D / alpha); of buddies, and of buddies times distance.
DENOMINATORS = tl.constexpr(1)
BUDDY_SUMS = tl.constexpr(2)


@triton.jit
@no_type_check
def own_points(own, numbers, KIND: tl.constexpr):
    """This program's own points, ``(OWN, 1)``; see ``points_at``."""
    start, length = place_of(own, numbers, OWN_LENGTH, CHANNELS)
    return points_at(start + tl.program_id(0) * OWN + tl.arange(0, OWN)[:, None], length, KIND)


@triton.jit
@no_type_check
def own_sums(out, numbers, MANY: tl.constexpr):
    """Where the sums of this program's own points go, ``(OWN,)``, and how far it is from channel to channel."""
    start, length = place_of(out, numbers, OWN_LENGTH, MANY)
    return start + tl.program_id(0) * OWN + tl.arange(0, OWN), length


@triton.jit
@no_type_check
def denominators(own, other, numbers, out, KIND: tl.constexpr):
    """Sums of exp(-D / alpha) over the other points."""
    item, mine = numbers_of(numbers, own), own_points(own, numbers, KIND)
    first, length = place_of(other, numbers, OTHER_LENGTH, CHANNELS)
    total = tl.zeros([OWN], tl.float64)
    total_rate = tl.zeros([OWN], tl.float64)
    for start in range(0, length, OTHER):
        theirs = points_at(first + start + tl.arange(0, OTHER)[None, :], length, KIND)
        at = tile(mine, theirs, item, KIND)
        total += tl.sum(at[0], 1)
        if RATES & KIND:
            logit_rate = tile_rates(mine, theirs, item, at, KIND)[0]
            total_rate += tl.sum(at[0] * logit_rate, 1)
    if RATES & KIND:
        place, step = own_sums(out, numbers, DENOMINATORS * 2)
        tl.store(place, total)
        tl.store(place + step, total_rate)
    else:
        place, step = own_sums(out, numbers, DENOMINATORS)
        tl.store(place, total)


@triton.jit
@no_type_check
def buddy_sums(own, other, numbers, out, KIND: tl.constexpr):
    """Sums of buddies, and of buddies times distance, over the other points, each counted with its weight."""
    item, mine = numbers_of(numbers, own), own_points(own, numbers, KIND)
    first, length = place_of(other, numbers, OTHER_LENGTH, CHANNELS)
    count, lengths = tl.zeros([OWN], tl.float64), tl.zeros([OWN], tl.float64)
    count_rate, lengths_rate = tl.zeros([OWN], tl.float64), tl.zeros([OWN], tl.float64)
    inverse, inverse_rate = mine[4][2], mine[4][4]
    for start in range(0, length, OTHER):
        theirs = points_at(first + start + tl.arange(0, OTHER)[None, :], length, KIND)
        at = tile(mine, theirs, item, KIND)
        e, distance = at[0], at[1]
        weight, other_inverse, other_rate = theirs[4][1], theirs[4][2], theirs[4][4]
        # Each factor is divided first: the square of the exponential would underflow long before the buddies do.
        buddies = (e * inverse) * (e * other_inverse) * weight
        count += tl.sum(buddies, 1)
        lengths += tl.sum(buddies * distance, 1)
        if RATES & KIND:
            rates = tile_rates(mine, theirs, item, at, KIND)
            change = 2.0 * rates[0] - inverse_rate - other_rate
            count_rate += tl.sum(buddies * change, 1)
            lengths_rate += tl.sum(buddies * (change * distance + rates[1]), 1)
    if RATES & KIND:
        place, step = own_sums(out, numbers, BUDDY_SUMS * 2)
        tl.store(place + 2 * step, count_rate)
        tl.store(place + 3 * step, lengths_rate)
    else:
        place, step = own_sums(out, numbers, BUDDY_SUMS)
    tl.store(place, count)
    tl.store(place + step, lengths)
