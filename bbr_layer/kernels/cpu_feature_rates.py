"""The sweeps of ``cpu_features.py`` in dual numbers; as ``cpu_dual.py`` and ``cpu_dual_forces.py`` otherwise.

Features do not move: what ``Pulled`` is added to here are the rates of what the gradient would add. Exponentials and
matched distances are kept, rates are not.
"""

import numpy as np

from bbr_layer.kernels.cpu_compiling import compiled
from bbr_layer.kernels.cpu_dual import weights_of
from bbr_layer.kernels.cpu_dual_forces import add_sums, loss_rates, row_rates
from bbr_layer.kernels.cpu_features import add_pull, likened
from bbr_layer.kernels.cpu_math import (
    CHUNK,
    COLUMN_OUT,
    COOL,
    COOL_RATE,
    INVERSE,
    INVERSE_RATE,
    ROW_OUT,
    SHARE_RATE,
    SMOOTH,
    SPACE,
    TILE,
    TWO,
    VELOCITY,
    WEIGHT,
    ZERO,
    share_of,
    wide_vectors,
)
from bbr_layer.kernels.cpu_pairs import (
    add_at,
    add_three,
    add_up,
    dot,
    inverse_of,
    kept_row,
    length,
    logit_rate,
    plus,
    point_of,
    scaled,
    slope_part_rates,
    three,
)


@compiled()
def feature_denominator_rates(sides, features, out, constants, kept):  # type: ignore[no-untyped-def]
    """As ``denominator_rates``."""
    wide_vectors()
    rows, columns = sides
    scales, cool_rate = (constants[SMOOTH], constants[COOL], constants[SPACE]), constants[COOL_RATE]
    sums = np.empty((2, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (vx, vy, vz) = three(columns, 0, first, last), three(columns, VELOCITY, first, last)
            total, total_rate = sums[0, first:last], sums[1, first:last]
            for i in range(low, high):
                px, py, pz = point_of(rows, i)
                row = row_rate = px * ZERO
                beside, seen = kept_row(features, i, first, last), kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset, velocity = (qx[j] - px, qy[j] - py, qz[j] - pz), (vx[j], vy[j], vz[j])
                    e, matched = likened(None, j, dot(offset, offset), beside[0][j], scales)
                    if kept is not None:
                        seen[0][j], seen[1][j] = e, matched
                    matched_rate = scales[2] * dot(offset, velocity) * inverse_of(matched)
                    e_rate = e * logit_rate(matched, matched_rate, scales[1], cool_rate)
                    row += e
                    row_rate += e_rate
                    total[j] += e
                    total_rate[j] += e_rate
                out[0][0, i] += row
                out[0][1, i] += row_rate
        add_up(out[1], sums)


@compiled()
def feature_buddy_sum_rates(sides, features, out, constants, kept):  # type: ignore[no-untyped-def]
    """As ``buddy_sum_rates``."""
    wide_vectors()
    rows, columns = sides
    scales, cool_rate = (constants[SMOOTH], constants[COOL], constants[SPACE]), constants[COOL_RATE]
    sums = np.empty((4, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (vx, vy, vz) = three(columns, 0, first, last), three(columns, VELOCITY, first, last)
            weight, inverse = columns[WEIGHT, first:last], columns[INVERSE, first:last]
            rate = columns[INVERSE_RATE, first:last]
            counts, lengths_rate = three(sums, 0, first, last), sums[3, first:last]
            for i in range(low, high):
                (px, py, pz), (own, own_inverse, own_rate) = point_of(rows, i), weights_of(rows, i)
                a = b = a_rate = b_rate = px * ZERO
                beside, seen = kept_row(features, i, first, last), kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset, velocity = (qx[j] - px, qy[j] - py, qz[j] - pz), (vx[j], vy[j], vz[j])
                    squared, half_rate = dot(offset, offset), dot(offset, velocity)
                    e, matched = likened(seen, j, squared, beside[0][j], scales)
                    distance, over = length(squared, scales[0])
                    distance_rate, matched_rate = half_rate * over, scales[2] * half_rate * inverse_of(matched)
                    buddies = share_of(e, own_inverse) * share_of(e, inverse[j])
                    change = TWO * logit_rate(matched, matched_rate, scales[1], cool_rate) - own_rate - rate[j]
                    buddies_rate, length_rate = buddies * change, buddies * (change * distance + distance_rate)
                    a, b = a + buddies * weight[j], b + buddies * weight[j] * distance
                    a_rate, b_rate = a_rate + buddies_rate * weight[j], b_rate + length_rate * weight[j]
                    add_at(counts, j, (buddies * own, buddies * own * distance, buddies_rate * own))
                    lengths_rate[j] += length_rate * own
                add_three(out[0], 0, i, (a, b, a_rate))
                out[0][3, i] += b_rate
        add_up(out[1], sums)


@compiled(forceinline=True)
def feature_pushes(motion, found, space, row, others):  # type: ignore[no-untyped-def]
    """Of one pair: the force along its offset, the pull of its features, heat and rounding, and the rates of each.

    ``motion`` is (half the rate of the square, distance, its inverse), ``found`` (exponential, matched distance),
    ``others`` (column, loss) of ``slope_part_rates``.
    """
    (half_rate, distance, over), (e, matched), (column, loss) = motion, found, others
    over_matched = inverse_of(matched)
    distance_rate, matched_rate = half_rate * over, space * half_rate * over_matched
    rates = logit_rate(matched, matched_rate, loss[0], loss[3]), distance_rate
    by_logit, held, by_logit_rate, held_rate = slope_part_rates((e, distance), rates, row, column, loss)
    held = held * over
    held_rate = (held_rate - held * distance_rate) * over
    pull = -by_logit * loss[0] * over_matched
    pull_rate = -((by_logit_rate - by_logit * loss[3]) * loss[0] + pull * matched_rate) * over_matched
    heat, heat_rate = by_logit * matched, by_logit_rate * matched + by_logit * matched_rate
    return (
        (held + space * pull, pull, heat, held + pull),
        (held_rate + space * pull_rate, pull_rate, heat_rate, held_rate + pull_rate),
    )


@compiled()
def feature_force_rates(sides, features, out, constants, kept):  # type: ignore[no-untyped-def]
    """``feature_forces`` and their rates."""
    wide_vectors()
    rows, columns = sides
    scales, loss = (constants[SMOOTH], constants[COOL], constants[SPACE]), loss_rates(constants)
    sums = np.empty((12, columns.shape[1]), dtype=rows.dtype)
    for low in range(0, rows.shape[1], CHUNK):
        high = min(low + CHUNK, rows.shape[1])
        sums[:] = 0
        for first in range(0, columns.shape[1], TILE):
            last = min(first + TILE, columns.shape[1])
            (qx, qy, qz), (vx, vy, vz) = three(columns, 0, first, last), three(columns, VELOCITY, first, last)
            f, g = three(sums, 0, first, last), three(sums, COLUMN_OUT, first, last)
            (weight, inverse, share) = three(columns, WEIGHT, first, last)
            inverse_rate, share_rate = columns[INVERSE_RATE, first:last], columns[SHARE_RATE, first:last]
            for i in range(low, high):
                (px, py, pz), row = point_of(rows, i), row_rates(rows, i)
                ax = ay = az = bx = by = bz = heat = heat_rate = rounding = rounding_rate = px * ZERO
                beside, seen = kept_row(features, i, first, last), kept_row(kept, i, first, last)
                for j in range(qx.size):
                    offset, velocity = (qx[j] - px, qy[j] - py, qz[j] - pz), (vx[j], vy[j], vz[j])
                    squared = dot(offset, offset)
                    found = likened(seen, j, squared, beside[0][j], scales)
                    column = weight[j], inverse[j], share[j], inverse_rate[j], share_rate[j]
                    motion = dot(offset, velocity), *length(squared, scales[0])
                    s, r = feature_pushes(motion, found, scales[2], row, (column, loss))
                    add_pull(beside, j, r[1])
                    heat, rounding = heat + s[2], rounding + s[3]
                    heat_rate, rounding_rate = heat_rate + r[2], rounding_rate + r[3]
                    x, y, z = scaled(offset, s[0])
                    ax, ay, az = ax - x, ay - y, az - z
                    add_at(f, j, (x, y, z))
                    x, y, z = plus(scaled(offset, r[0]), scaled(velocity, s[0]))
                    bx, by, bz = bx - x, by - y, bz - z
                    add_at(g, j, (x, y, z))
                add_three(out[0], 0, i, (ax, ay, az))
                add_three(out[0], ROW_OUT, i, (bx, by, bz))
                add_sums(out[0], i, (heat, rounding), (heat_rate, rounding_rate))
        add_up(out[1], sums)
