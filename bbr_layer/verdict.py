"""How far to trust the registration of two clouds, in numbers and in one sentence."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

# A pair is close when its points lie nearer to each other than to the next points of their own clouds, on average.
# One surface sampled twice has 0.85 of its mutual neighbours close, whatever its shape. Measured on 51 registrations
# of 17 real pairs (streets, rooms, statuettes, 2D): right answers 0.75 to 1, answers 2 deg and more off 0.3 to 0.73.
CLOSE_SHARE = 0.75
# Points of each cloud that this share is counted on: with 10 000 the sensor's noise is wider than the spacing, and
# right answers fall to 0.6; with 1000 to 4000 they do not.
JUDGED_POINTS = 2000
# Fewer of the points than this have a buddy where clouds that barely meet were registered; right answers had 0.19
# and more, answers wrong by 30 degrees 0.03 to 0.17.
FEWEST_BUDDIES = 0.1
# An eigenvalue below this share of the largest is 0 but for rounding.
ROUNDING_SHARE = 1e-12


@dataclass(frozen=True)
class WeakestDirection:
    """The motion that the paired points resist least, about the centroid of the moved source.

    Parameters
    ----------
    turning: a rotation (True) or a translation.
    axis: ``(d,)`` unit vector on the target's axes; of a rotation in 2D ``(0, 0, 1)``.
    deviation: how far the answer may be off along it: one standard deviation, radians or the data's unit, if the
        residuals were independent; infinite where nothing resists.
    share: what resists it, as a share of the mean over all directions, 0 to 1.
    """

    turning: bool
    axis: Float[np.ndarray, "d"]
    deviation: float
    share: float


@dataclass(frozen=True)
class Verdict:
    """What the pairs of an answer say about it.

    Parameters
    ----------
    buddies: how many pairs are mutual nearest neighbours.
    buddy_share: as a share of the smaller cloud.
    residual_rms: root mean square distance of the pairs, in the data's unit.
    close_share: share of the pairs whose points are closer to each other than to the next ones of their own clouds.
    weakest: the direction of motion that the pairs hold least.
    trustworthy: whether everything speaks for the answer.
    sentence: the same in words.
    """

    buddies: int
    buddy_share: float
    residual_rms: float
    close_share: float
    weakest: WeakestDirection
    trustworthy: bool
    sentence: str


def give_verdict(
    P: Float[np.ndarray, "n d"],
    moved: Float[np.ndarray, "m d"],
    information: Float[np.ndarray, "k k"],
    status_words: str,
) -> Verdict:
    """Judge an answer.

    Parameters
    ----------
    P, moved: ``(n, d)`` target and ``(m, d)`` source already carried onto it.
    information: ``(k, k)``, k = d (d + 1) / 2, as ``Registration`` has it.
    status_words: its words; anything but "converged" forbids trust.
    """
    distances, _ = _mutual_pairs(P, moved)
    rms = float(np.sqrt(np.mean(distances**2)))
    share = len(distances) / min(len(P), len(moved))
    close = _close_share(_thinned(P), _thinned(moved))
    doubts = _doubts(status_words, share, close)
    return Verdict(
        buddies=len(distances),
        buddy_share=share,
        residual_rms=rms,
        close_share=close,
        weakest=weakest_direction(information, moved, rms),
        trustworthy=not doubts,
        sentence=_sentence(doubts, share, close),
    )


def weakest_direction(
    information: Float[np.ndarray, "k k"], moved: Float[np.ndarray, "m d"], rms: float
) -> WeakestDirection:
    """Where the answer gives way most easily; rotations count by how far they move a point at the mean radius."""
    d = moved.shape[1]
    turns = d * (d - 1) // 2
    radius = float(np.sqrt(np.mean(np.sum((moved - moved.mean(axis=0)) ** 2, axis=1)))) or 1.0
    unit = np.concatenate((np.full(turns, 1 / radius), np.ones(d)))
    values, vectors = np.linalg.eigh(np.nan_to_num(information) * unit[:, None] * unit)
    rotation, translation = vectors[:turns, 0], vectors[turns:, 0]
    turning = bool(np.linalg.norm(rotation) > np.linalg.norm(translation))
    axis = rotation if turning else translation
    if turning and d == 2:
        axis = np.array([0.0, 0.0, 1.0])
    axis = axis / np.linalg.norm(axis)
    axis = axis * np.sign(axis[np.abs(axis).argmax()])  # an axis has no sense: its largest part is made positive
    deviation = rms / np.sqrt(values[0]) if values[0] > ROUNDING_SHARE * values[-1] else np.inf
    share = max(float(values[0]), 0.0) / float(values.mean()) if values.mean() > 0 else 0.0
    return WeakestDirection(turning, axis, float(deviation) / (radius if turning else 1.0), share)


def _mutual_pairs(P: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the mutual nearest neighbours, ``(b,)``, and the indices of their points, ``(b, 2)``."""
    to_target, nearest_target = cKDTree(P).query(moved)
    mutual = cKDTree(moved).query(P)[1][nearest_target] == np.arange(len(moved))
    return to_target[mutual], np.stack((nearest_target[mutual], np.flatnonzero(mutual)), axis=1)


def _thinned(points: np.ndarray) -> np.ndarray:
    return points[np.random.default_rng(0).permutation(len(points))[:JUDGED_POINTS]]


def _close_share(P: np.ndarray, moved: np.ndarray) -> float:
    distances, pairs = _mutual_pairs(P, moved)
    gaps = [cKDTree(cloud).query(cloud, k=2)[0][:, 1] for cloud in (P, moved)]
    return float(np.mean(distances <= (gaps[0][pairs[:, 0]] + gaps[1][pairs[:, 1]]) / 2))


def _doubts(status_words: str, share: float, close: float) -> list[str]:
    doubts = [] if status_words == "converged" else [status_words.split(":")[0]]
    if close < CLOSE_SHARE:
        doubts.append(f"only {close:.0%} of the pairs are closer than the points around them, on one surface 85%")
    if share < FEWEST_BUDDIES:
        doubts.append(f"only {share:.0%} of the points have a best buddy")
    return doubts


def _sentence(doubts: list[str], share: float, close: float) -> str:
    if doubts:
        advice = "Try several starts (--starts 7), or one near the answer (--start)."
        return f"Do not trust this without a look: {'; '.join(doubts)}. {advice}"
    return (
        f"Trustworthy: {share:.0%} of the points have a best buddy, {close:.0%} of them closer than their neighbours."
    )
