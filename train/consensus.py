"""The motions that many matches of features agree on, most of the matches being wrong.

Source: Z. Chen et al., SC2-PCR: A Second Order Spatial Compatibility for Efficient and Robust Point Cloud Registration,
CVPR 2022: two matches are compatible where they keep their distance; the more third matches are compatible with both,
the likelier both are right.
"""

import numpy as np
from jaxtyping import Float
from trimesh.registration import procrustes

# Matches around one seed that give its motion, and seeds tried.
GROUP, SEEDS = 20, 60
# Motions within this many tolerances of each other, at all points, count as one.
APART = 3.0


def consensus(
    target: Float[np.ndarray, "c 3"], source: Float[np.ndarray, "c 3"], tolerance: float, most: int
) -> list[Float[np.ndarray, "4 4"]]:
    """At most ``most`` different motions ``target_from_source``, those that most matches agree with first.

    Parameters
    ----------
    target, source: the two points of each match.
    tolerance: how far off its target a match may end, in the data's unit.
    most: of motions.
    """
    lengths = [np.linalg.norm(x[:, None] - x, axis=-1) for x in (target, source)]
    alike = np.abs(lengths[0] - lengths[1]) < tolerance
    # Neighbours keep their distance under every motion.
    alike &= np.minimum(*lengths) > 2 * tolerance
    support = alike * (alike.astype(np.float32) @ alike.astype(np.float32))
    seeds = np.argsort(-support.sum(axis=1))[: 5 * SEEDS : 5] if len(support) > 5 * SEEDS else np.arange(len(support))
    found = []
    for seed in seeds:
        group = np.append(np.argsort(-support[seed])[:GROUP], seed)
        motion = placed(target[group], source[group])
        for _ in range(3):
            close = _off(motion, target, source) < tolerance
            if close.sum() < 4:
                break
            motion = placed(target[close], source[close])
        found.append((int((_off(motion, target, source) < tolerance).sum()), motion))
    chosen: list[np.ndarray] = []
    for _, motion in sorted(found, key=lambda one: -one[0]):
        moved = source @ motion[:-1, :-1].T + motion[:-1, -1]
        if all(np.mean(_off(other, moved, source)) > APART * tolerance for other in chosen):
            chosen.append(motion)
        if len(chosen) == most:
            break
    return chosen


def placed(target: Float[np.ndarray, "n 3"], source: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 4"]:
    """The rigid motion that brings ``source`` closest to ``target``."""
    return procrustes(source, target, reflection=False, scale=False, return_cost=False)


def _off(motion: np.ndarray, target: np.ndarray, source: np.ndarray) -> np.ndarray:
    return np.linalg.norm(source @ motion[:-1, :-1].T + motion[:-1, -1] - target, axis=1)
