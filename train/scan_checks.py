"""What a scan must be like to be mapped."""

import numpy as np
from jaxtyping import Float

# A scan that lies farther from its origin than this many times its own size was not seen from there. Measured on
# simulated scans of a plane and of space, shifted: up to here their points end where unshifted ones do, at 40 000 times
# a metre off, as float32 no longer resolves them. Scans of a sensor, or of an object before one, have at most 4.
FARTHEST_ORIGIN = 1000.0


def check_scan(name: str, scan: Float[np.ndarray, "n d"]) -> None:
    """Refuse a scan that no pose can be found for.

    Raises
    ------
    ValueError: NaN, fewer than d points, or a scan so far from its origin that no sensor was there.
    """
    if not np.isfinite(scan).all():
        raise ValueError(f"scan {name} is not finite; leave it out")
    needed = scan.shape[1]
    if len(scan) < needed:
        raise ValueError(f"scan {name} has {len(scan)} points; in {needed}D at least {needed} are needed: leave it out")
    middle = np.median(scan, axis=0)
    away, size = np.linalg.norm(middle), np.median(np.linalg.norm(scan - middle, axis=1))
    if away > FARTHEST_ORIGIN * size > 0:
        raise ValueError(
            f"scan {name} lies {away:.6g} from its origin and is about {size:.3g} wide, so no sensor was at its "
            "origin, as in coordinates of a country: subtract from each scan the place of its sensor, or one place "
            "among them from all"
        )
