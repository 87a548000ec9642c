"""What the sweeps in Triton read, and what they compute for a tile of pairs of points.

Both clouds take both parts. A sweep sums over the points of one, ``other``, for every point of the other one, ``own``;
it is launched twice, with the two exchanged. No sum is shared by two programs: no atomics, and the same answer every
time. Offsets run from other to own, and the normal of Eq. 7 is taken as ``n_own + sign n_other``: whichever cloud is
``own``, the derivatives by a point and by its normal are then the same formulas, without a sign.
"""

from typing import no_type_check

import triton
import triton.language as tl

# A program takes OWN points and goes through the others OTHER at a time: a row of a tile for each of four warps, two
# pairs a thread. With more of them, the last sweep runs out of registers (seen in the compiler's report for sm_90).
OWN = tl.constexpr(4)
OTHER = tl.constexpr(64)

# Channels of a cloud, ``(batch, CHANNELS, length)``: coordinates (three; 0 where there are two), normals, weight, 1 for
# real points, inverse of the denominator in Eq. 4, weight times share of the loss; then velocities of coordinates and
# normals, and the rates of change of denominator (relative) and weighted share. Length is a multiple
# of OTHER, and so of OWN, and what pads it is 0: loads and stores need no bound.
POINT = tl.constexpr(0)
NORMAL = tl.constexpr(3)
WEIGHT = tl.constexpr(6)
REAL = tl.constexpr(7)
INVERSE = tl.constexpr(8)
SHARE = tl.constexpr(9)
VELOCITY = tl.constexpr(10)
NORMAL_VELOCITY = tl.constexpr(13)
INVERSE_RATE = tl.constexpr(16)
SHARE_RATE = tl.constexpr(17)
CHANNELS = tl.constexpr(18)

# Numbers of an item, ``(batch, NUMBERS)`` float64: lengths of own and other, smoothing squared, 1 / alpha, derivatives
# of the loss by S and by M, 1 to align signs; then the rates of change of alpha over alpha and of the two derivatives.
OWN_LENGTH = tl.constexpr(0)
OTHER_LENGTH = tl.constexpr(1)
SMOOTH = tl.constexpr(2)
COOL = tl.constexpr(3)
BY_S = tl.constexpr(4)
BY_M = tl.constexpr(5)
ALIGN = tl.constexpr(6)
COOL_RATE = tl.constexpr(7)
BY_S_RATE = tl.constexpr(8)
BY_M_RATE = tl.constexpr(9)
NUMBERS = tl.constexpr(10)

# What a sweep is compiled for, added up: distances to planes instead of points; rates of change too.
PLANES = tl.constexpr(1)
RATES = tl.constexpr(2)


@triton.jit
@no_type_check
def numbers_of(numbers, cloud):
    """The numbers of this program's item from SMOOTH on, in the precision of the points."""
    place = numbers + tl.program_id(1) * NUMBERS
    dtype = cloud.dtype.element_ty
    return (
        tl.load(place + SMOOTH).to(dtype),
        tl.load(place + ALIGN).to(dtype),
        (tl.load(place + COOL).to(dtype), tl.load(place + BY_S).to(dtype), tl.load(place + BY_M).to(dtype)),
        (
            tl.load(place + COOL_RATE).to(dtype),
            tl.load(place + BY_S_RATE).to(dtype),
            tl.load(place + BY_M_RATE).to(dtype),
        ),
    )


@triton.jit
@no_type_check
def place_of(cloud, numbers, WHOSE: tl.constexpr, MANY: tl.constexpr):
    """Where this program's item begins in an array of MANY channels, and how far it is from channel to channel."""
    length = tl.load(numbers + tl.program_id(1) * NUMBERS + WHOSE).to(tl.int32)
    return cloud + tl.program_id(1).to(tl.int64) * MANY * length, length


@triton.jit
@no_type_check
def points_at(place, length, KIND: tl.constexpr):
    """Coordinates, normals, their velocities, and (real, weight, inverse, share, rates of the two) of some points."""
    point = tl.load(place), tl.load(place + length), tl.load(place + 2 * length)
    normal, velocity, normal_velocity = point, point, point
    if PLANES & KIND:
        at = place + NORMAL * length
        normal = tl.load(at), tl.load(at + length), tl.load(at + 2 * length)
    if RATES & KIND:
        at = place + VELOCITY * length
        velocity = tl.load(at), tl.load(at + length), tl.load(at + 2 * length)
        at = place + NORMAL_VELOCITY * length
        normal_velocity = tl.load(at), tl.load(at + length), tl.load(at + 2 * length)
    real, weight = tl.load(place + REAL * length), tl.load(place + WEIGHT * length)
    inverse, share = tl.load(place + INVERSE * length), tl.load(place + SHARE * length)
    inverse_rate, share_rate = tl.load(place + INVERSE_RATE * length), tl.load(place + SHARE_RATE * length)
    return point, normal, velocity, normal_velocity, (real, weight, inverse, share, inverse_rate, share_rate)


@triton.jit
@no_type_check
def dot(a, b):
    """Inner product of two vectors of space."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
@no_type_check
def tile(own, other, item, KIND: tl.constexpr):
    """Of all pairs of a tile: exp(-D / alpha), distance, its inverse (0 at 0), offset, direction, residual, sign.

    Between points the direction is the offset and the residual 1; to planes they are the sum of the two normals and
    the residual of Eq. 7. Of the exponential nothing is subtracted first: distances are not negative, and the epsilon
    of Eq. 4 keeps the denominators above 0. Where a point is not real it is 0.
    """
    a, n, b, m = own[0], own[1], other[0], other[1]
    offset = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    squared = dot(offset, offset)
    sign = squared * 0.0 + 1.0
    along, residual = offset, sign
    if PLANES & KIND:
        sign = tl.where(item[1] * dot(n, m) < 0.0, -sign, sign)
        along = n[0] + sign * m[0], n[1] + sign * m[1], n[2] + sign * m[2]
        residual = dot(offset, along)
        squared = residual * residual
    distance = tl.sqrt(squared + item[0])
    over = tl.where(distance > 0.0, 1.0 / tl.where(distance > 0.0, distance, 1.0), 0.0)
    e = own[4][0] * other[4][0] * tl.exp(-distance * item[2][0])
    return e, distance, over, offset, along, residual, sign


@triton.jit
@no_type_check
def tile_rates(own, other, item, at, KIND: tl.constexpr):
    """Rates of change of -D / alpha, distance, offset, direction, residual; ``at`` is what ``tile`` answered."""
    a, n, b, m = own[2], own[3], other[2], other[3]
    e, distance, over, offset, along, residual, sign = at
    velocity = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    along_rate, residual_rate = velocity, residual * 0.0
    distance_rate = dot(offset, velocity) * over
    if PLANES & KIND:
        along_rate = n[0] + sign * m[0], n[1] + sign * m[1], n[2] + sign * m[2]
        residual_rate = dot(velocity, along) + dot(offset, along_rate)
        distance_rate = residual * residual_rate * over
    logit_rate = item[2][0] * (distance * item[3][0] - distance_rate)
    return logit_rate, distance_rate, velocity, along_rate, residual_rate
