"""Arithmetic of the compiled sweeps: a vectorised exponential, and the channels they read."""

import inspect
import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload

from bbr_layer.kernels.cpu_compiling import FAST

# Columns that a row is compared with at a time: a dozen arrays of this many float32 stay in a 64 KiB cache.
TILE = 1024
# Rows whose sums over columns are added up in the points' own precision, before they go on in float64.
CHUNK = 64
# Pairs of an item whose exponentials and distances the first sweep keeps for the others, 8 MiB in float32: loading
# them is faster than computing them again. Chosen.
KEPT_PAIRS = 2**20
# Channels of the rows (target points) and columns (moved source points): coordinates from 0, then the point's weight,
# the inverse of its denominator in Eq. 4, the share of the loss that hangs on it, and the rates of change of both.
WEIGHT, INVERSE, SHARE, INVERSE_RATE, SHARE_RATE, CHANNELS = 3, 4, 5, 6, 7, 8
# Channels that only columns have: velocity of the moved point.
VELOCITY, COLUMN_CHANNELS = 8, 11
# Channels of the gradient per row and per column, each followed by its rate where rates are asked for: force 0 to 2,
# derivative by the normal 3 to 5; of rows also the sums of dL/du D for the temperature and dL/dD / D for the rounding.
HEAT, ROUND = 6, 7
ROW_OUT, COLUMN_OUT = 8, 6
# Constants of an item: smoothing squared, 1 / alpha, derivatives of the loss by S and by M, 1 to align signs; then the
# rates of change of alpha over alpha and of the two derivatives; then 1 where coordinates count beside features.
SMOOTH, COOL, BY_S, BY_M, ALIGN, COOL_RATE, BY_S_RATE, BY_M_RATE, SPACE, CONSTANTS = 0, 1, 2, 3, 4, 5, 6, 7, 8, 9

F32 = np.float32
LOG2_E = F32(1 / math.log(2))
# exp2 on [-1/2, 1/2]: Taylor coefficients ln(2)^k / k!; the first one left out is 1.2e-7 of the value at the ends.
EXP2 = tuple(F32(math.log(2) ** k / math.factorial(k)) for k in range(7))
# Below the smallest normal number of float32, 2^-126, many processors are slow. Exponentials end 2^10 above it, so that
# over denominators up to 1024 none falls below; shares of a denominator less than 2^-60 count as 0, so that no product
# of two does.
LOWEST_EXPONENT, EXPONENT_BIAS, MANTISSA_BITS = F32(-116.0), np.int32(127), np.int32(23)
FAINT = F32(2.0**-60)
HALF, ZERO, ONE, TWO = F32(0.5), F32(0.0), F32(1.0), F32(2.0)


def _float_of_bits(typing_context, bits):  # type: ignore[no-untyped-def]
    """The float32 with the bits of an int32."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), generate


float_of_bits: Any = intrinsic(inspect.unwrap(_float_of_bits))


def exp_negative(x: float) -> float:
    """exp(x) for x <= 0: to rounding in float64; in float32 to 6e-8 |x|, as x itself is rounded; 1e-35 below -80."""
    return math.exp(x)


@overload(exp_negative, inline="never", jit_options={"fastmath": FAST})
def _exp_negative(x):  # type: ignore[no-untyped-def]
    if x == types.float64:
        return lambda x: math.exp(x)

    def single(x):  # type: ignore[no-untyped-def]
        scaled = max(x * LOG2_E, LOWEST_EXPONENT)
        whole = np.int32(scaled - HALF)  # cut towards zero: rounded to the nearest, as x <= 0
        rest = scaled - F32(whole)
        value = EXP2[5] + rest * EXP2[6]
        value = EXP2[3] + rest * (EXP2[4] + rest * value)
        value = EXP2[0] + rest * (EXP2[1] + rest * (EXP2[2] + rest * value))
        return value * float_of_bits((whole + EXPONENT_BIAS) << MANTISSA_BITS)

    return inspect.unwrap(single)


def share_of(e: float, inverse: float) -> float:
    """``e`` times an inverse denominator, at most 1; in float32 0 where that is below 2^-60."""
    return e * inverse


@overload(share_of, inline="never", jit_options={"fastmath": FAST})
def _share_of(e, inverse):  # type: ignore[no-untyped-def]
    if e == types.float64:
        return lambda e, inverse: e * inverse

    def single(e, inverse):  # type: ignore[no-untyped-def]
        share = e * inverse
        return share if share > FAINT else ZERO

    return inspect.unwrap(single)


def _wide_vectors(typing_context):  # type: ignore[no-untyped-def]
    """Called in a function: let it use vectors of 512 bits where the processor has them.

    LLVM keeps to 256 bits on many processors that have 512, for the sake of code that uses them here and there; the
    sweeps do nothing else.
    """

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        # llvmlite's own ``add`` refuses attributes that it does not know, as all that are written as strings.
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


wide_vectors: Any = intrinsic(inspect.unwrap(_wide_vectors))
