"""How far to trust the registration of two clouds, in numbers and in one sentence."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

# An answer is believed from this probability on. `python -m benchmarks.reliability`: 13 of 532 wrong answers are above
# it and 2 of 1132 right ones below; a threshold on the share of close pairs trusted 29 and doubted 23.
BELIEVED = 0.5


@dataclass(frozen=True)
class Verdict:
    """What the pairs of an answer say about it.

    Parameters
    ----------
    buddies: how many pairs are mutual nearest neighbours.
    buddy_share: as a share of the smaller cloud.
    residual_rms: root mean square distance of the pairs, in the data's unit.
    confidence: probability that the answer is right, as ``Registration`` has it.
    trustworthy: whether everything speaks for the answer.
    sentence: the same in words.
    """

    buddies: int
    buddy_share: float
    residual_rms: float
    confidence: float
    trustworthy: bool
    sentence: str


def give_verdict(
    P: Float[np.ndarray, "n d"], moved: Float[np.ndarray, "m d"], confidence: float, status_words: str
) -> Verdict:
    """Judge an answer.

    Parameters
    ----------
    P, moved: ``(n, d)`` target and ``(m, d)`` source already carried onto it.
    confidence, status_words: as ``Registration`` has them; anything but "converged" forbids trust.
    """
    distances = _pair_distances(P, moved)
    doubts = _doubts(status_words, confidence)
    return Verdict(
        buddies=len(distances),
        buddy_share=len(distances) / min(len(P), len(moved)),
        residual_rms=float(np.sqrt(np.mean(distances**2))),
        confidence=confidence,
        trustworthy=not doubts,
        sentence=_sentence(doubts, confidence),
    )


def _pair_distances(P: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Distances of the mutual nearest neighbours, ``(b,)``."""
    to_target, nearest_target = cKDTree(P).query(moved)
    mutual = cKDTree(moved).query(P)[1][nearest_target] == np.arange(len(moved))
    return to_target[mutual]


def _doubts(status_words: str, confidence: float) -> list[str]:
    doubts = [] if status_words == "converged" else [status_words.split(":")[0]]
    if confidence < BELIEVED:
        doubts.append(f"the probability that it is right is {confidence:.2f}")
    return doubts


def _sentence(doubts: list[str], confidence: float) -> str:
    if doubts:
        advice = "Try several starts (--preset robust), or one near the answer (--start)."
        return f"Do not trust this without a look: {'; '.join(doubts)}. {advice}"
    return f"Trustworthy: the probability that it is right is {confidence:.2f}."
