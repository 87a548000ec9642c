"""Between the compiled sweeps: what the sums of one item say about its rows, its columns and its loss."""

from bbr_layer.kernels.cpu_math import (
    BY_M,
    BY_M_RATE,
    BY_S,
    BY_S_RATE,
    INVERSE,
    INVERSE_RATE,
    SHARE,
    SHARE_RATE,
    WEIGHT,
    compiled,
)


@compiled()
def invert(side, sums, outlier, rates):  # type: ignore[no-untyped-def]
    """Inverse denominators of Eq. 4 and, if asked, their relative rates, from sums ``(channels, points)``."""
    for i in range(side.shape[1]):
        total = sums[0, i] + outlier
        side[INVERSE, i] = 1 / total
        if rates:
            side[INVERSE_RATE, i] = sums[1, i] / total


@compiled()
def weighted_total(side, sums, channel):  # type: ignore[no-untyped-def]
    """The sum over all points of one channel times their weight."""
    total = 0.0
    for i in range(side.shape[1]):
        total += side[WEIGHT, i] * sums[channel, i]
    return total


@compiled()
def settle_loss(rows, sums, constants, mean, rates):  # type: ignore[no-untyped-def]
    """The loss from S and M; its derivatives by both, and their rates, go into the constants (``loss_of_sums``)."""
    S, M = weighted_total(rows, sums, 0), weighted_total(rows, sums, 1)
    constants[BY_S], constants[BY_M], constants[BY_S_RATE], constants[BY_M_RATE] = -1.0, 0.0, 0.0, 0.0
    if not mean:
        return -S
    if S <= 0:
        constants[BY_S] = 0.0
        return 0.0
    loss = M / S
    constants[BY_S], constants[BY_M] = -loss / S, 1 / S
    if rates:
        S_rate, M_rate = weighted_total(rows, sums, 2), weighted_total(rows, sums, 3)
        loss_rate = (M_rate - loss * S_rate) / S
        constants[BY_S_RATE] = (loss * S_rate / S - loss_rate) / S
        constants[BY_M_RATE] = -S_rate / (S * S)
    return loss


@compiled()
def settle_shares(side, sums, constants, shares, rates):  # type: ignore[no-untyped-def]
    """The loss per unit of weight of each point (and its rate) into ``shares``, times the weight into ``side``."""
    for i in range(side.shape[1]):
        share = constants[BY_S] * sums[0, i] + constants[BY_M] * sums[1, i]
        shares[0, i] = share
        side[SHARE, i] = share * side[WEIGHT, i]
        if rates:
            change = constants[BY_S_RATE] * sums[0, i] + constants[BY_S] * sums[2, i]
            change += constants[BY_M_RATE] * sums[1, i] + constants[BY_M] * sums[3, i]
            shares[1, i] = change
            side[SHARE_RATE, i] = change * side[WEIGHT, i]
