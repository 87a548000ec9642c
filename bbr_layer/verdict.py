"""How far to trust the registration of two clouds, in numbers and in one sentence."""

from dataclasses import dataclass

from bbr_layer.registration import Registration

# An answer is believed from this probability on. `python -m benchmarks.reliability`: 14 of 550 wrong answers are above
# it and 3 of 1234 right ones below; a threshold on the share of close pairs trusted 37 and doubted 23.
BELIEVED = 0.5


@dataclass(frozen=True)
class Verdict:
    """What the pairs of an answer say about it.

    Parameters
    ----------
    buddies: how many pairs are mutual nearest neighbours.
    buddy_share: as a share of the smaller cloud.
    residual_rms: ``Registration.residual``, point to plane where the loss has normals.
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


def give_verdict(found: Registration, points: int) -> Verdict:
    """Judge an answer without batch dimensions.

    Parameters
    ----------
    found: the answer; words other than "converged" forbid trust.
    points: of the smaller cloud.
    """
    confidence, buddies = float(found.confidence), int(found.buddies)
    doubts = _doubts(str(found.words), confidence)
    return Verdict(
        buddies=buddies,
        buddy_share=buddies / points,
        residual_rms=float(found.residual),
        confidence=confidence,
        trustworthy=not doubts,
        sentence=_sentence(doubts, confidence),
    )


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
