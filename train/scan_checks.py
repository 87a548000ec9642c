"""What a scan must be like to be mapped, and what is left out of one so that it is."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# Different points off its origin that a scan must have. Measured with one scan of a simulated room thinned to so many:
# from 10 on the map ends within 5 mm of the truth, with 5 it is 4 cm off, with 2 a quarter of a metre, with 3 lost.
FEWEST_POINTS = 10
# A scan that lies farther from its origin than this many times its own size was not seen from there. Measured on
# simulated scans of a plane and of space, shifted: up to here their points end where unshifted ones do, at 40 000 times
# a metre off, as float32 no longer resolves them. Scans of a sensor, or of an object before one, have at most 4.
FARTHEST_ORIGIN = 1000.0
# Points farther than this many times the range within which this share of all points lies were not seen: codes for no
# return (65535), slips of a digit. In the sequences of benchmarks/mapping_table.md the farthest one is at 14 times.
FARTHEST_POINT, MOST_POINTS = 100.0, 0.75
# Of a scan that would lose more than this share, not its points but its frame or its unit is wrong.
MOST_LOST = 0.5
# So many scans or files are named in a sentence.
NAMED = 5
# Heights within this share of the farthest coordinate are one: what rounding to float32 leaves of it, several times.
SAME_HEIGHT = 1e-6
# Thickness, as a share of the length, below which a scan in space is flat. Measured on tilted planar scans, shaken out
# of it: at 9e-8 of their length they are mapped, at 6e-8 and less, as rounded to float32, they stay where they begin.
THINNEST = 1e-7


def check_scan(name: str, scan: Float[np.ndarray, "n d"]) -> None:
    """Refuse a scan that no pose can be found for.

    Raises
    ------
    ValueError: NaN, fewer than ``FEWEST_POINTS`` different points off the origin, or a scan so far from its origin
        that no sensor was there.
    """
    if not np.isfinite(scan).all():
        raise ValueError(f"scan {name} is not finite; leave it out")
    if (few := _different_points(scan)) < FEWEST_POINTS:
        raise ValueError(
            f"of the {len(scan)} points of scan {name} {few} are off its origin and differ; a pose needs at least "
            f"{FEWEST_POINTS}: leave it out"
        )
    middle = np.median(scan, axis=0)
    away, size = np.linalg.norm(middle), np.median(np.linalg.norm(scan - middle, axis=1))
    if away > FARTHEST_ORIGIN * size > 0:
        raise ValueError(
            f"scan {name} lies {away:.6g} from its origin and is about {size:.3g} wide, so no sensor was at its "
            "origin, as in coordinates of a country: subtract from each scan the place of its sensor, or one place "
            "among them from all"
        )


def _different_points(scan: Float[np.ndarray, "n d"]) -> int:
    """How many points off the origin, which no sensor sees, differ; counted up to ``FEWEST_POINTS``."""
    rest, count = scan[scan.any(axis=1)], 0
    while len(rest) and count < FEWEST_POINTS:
        rest = rest[(rest != rest[0]).any(axis=1)]
        count += 1
    return count


def without_far_points(
    scans: list[Float[np.ndarray, "_ _"]], names: Sequence[str]
) -> tuple[list[Float[np.ndarray, "_ _"]], list[str]]:
    """The scans without points that are too far to have been seen, and a sentence on them if there were any.

    Raises
    ------
    ValueError: more than half of a scan would go.
    """
    with np.errstate(over="ignore"):
        ranges = [np.linalg.norm(scan, axis=1) for scan in scans]
    seen = np.concatenate(ranges)
    seen = seen[seen > 0]
    limit = FARTHEST_POINT * float(np.quantile(seen, MOST_POINTS, method="lower")) if len(seen) else np.inf
    lost = {number: int((far > limit).sum()) for number, far in enumerate(ranges) if (far > limit).any()}
    reason = f"farther than {limit:.4g} from their sensor, {FARTHEST_POINT:g} times as far as most points of all scans"
    for number, count in lost.items():
        if count > MOST_LOST * len(scans[number]):
            whole = f"of the {len(scans[number])} points of scan {names[number]} {count} lie {reason}"
            raise ValueError(f"{whole}: leave it out, or give it in its sensor's frame and the unit of the others")
    if not lost:
        return scans, []
    named = listed([f"{count} in {names[number]}" for number, count in lost.items()])
    kept = [scan[far <= limit] for scan, far in zip(scans, ranges, strict=True)]
    return kept, [f"points that lie {reason} were left out: {named}"]


def listed(names: Sequence[str]) -> str:
    """The first few of many in words.

    >>> listed(["a", "b", "c", "d", "e", "f", "g"])
    'a, b, c, d, e and 2 more'
    """
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def without_height(scans: list[Float[np.ndarray, "_ _"]]) -> tuple[list[Float[np.ndarray, "_ _"]], list[str]]:
    """The scans in the plane, ``(n, 2)``, if all points lie at one height, and a sentence on it unless that is 0."""
    heights = np.concatenate([scan[:, 2] if scan.shape[1] == 3 else np.zeros(1) for scan in scans])
    low, high = float(heights.min()), float(heights.max())
    if high - low > SAME_HEIGHT * max(float(np.abs(scan[:, :2]).max()) for scan in scans):
        return scans, []
    flat = [np.ascontiguousarray(scan[:, :2]) for scan in scans]
    return flat, [f"all points lie at z = {high:.6g}; they are mapped in the plane"] if low or high else []


def check_depth(scans: Sequence[Float[np.ndarray, "_ 3"]]) -> None:
    """Refuse scans in space that are all flat, as nothing then tells how they moved within their planes.

    Raises
    ------
    ValueError: every scan is a piece of a plane.
    """
    if all(_is_flat(scan) for scan in scans):
        raise ValueError(
            "every scan is flat and its z varies, so in space nothing holds it in its plane: turn the scans so "
            "that z is constant, and they are mapped in the plane"
        )


def _is_flat(scan: Float[np.ndarray, "n 3"]) -> bool:
    lengths = np.linalg.svd(scan - scan.mean(axis=0), compute_uv=False)
    return bool(lengths[-1] <= THINNEST * lengths[0])
