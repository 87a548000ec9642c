"""What a simulated world is asked to be, and the random streams that make it the same again."""

from dataclasses import dataclass, fields
from typing import Literal, get_args

import numpy as np

Kind = Literal["rooms", "loop", "corridor"]
# One independent random stream per purpose, so that adding movers or noise leaves the building as it was.
STREAMS = ("plan", "route", "furniture", "movers", "noise")


@dataclass(frozen=True)
class WorldSettings:
    """A world to be scanned; lengths in metres.

    Parameters
    ----------
    kind: ``"rooms"`` (a loop through a corridor and through rooms), ``"loop"`` (once around a corridor) or
        ``"corridor"`` (along a hallway, around a hall and back).
    dimension: 2 (one horizontal plane of rays) or 3 (a spinning lidar with several rings).
    scans: how many scans. Buildings grow with it, so that consecutive scans stay 0.3 to 0.5 m and less than
        15 deg apart; with fewer than 64 the robot moves up to 0.75 m and 20 deg, with fewer than about 45 it
        stops before the loop is closed. Beyond about 285 scans (120 m) buildings grow no more: a loop is driven
        again and again, a corridor more slowly.
    beams: rays per scan in 2D, rays per ring in 3D, evenly over the field of view.
    rings: rings of the 3D lidar, ignored in 2D.
    noise_m: standard deviation of a range. range_max_m: nothing is returned from beyond.
    movers: how many people and trolleys move between the scans.
    field_of_view_deg: horizontal, centred on the heading.
    ceiling: close the 3D world from above (a map of it then shows nothing but the ceiling from the top).
    seed: another seed is another building, another walk and other noise.

    Raises
    ------
    ValueError: a setting outside its range.
    """

    kind: Kind = "rooms"
    dimension: int = 2
    scans: int = 64
    beams: int = 256
    rings: int = 16
    noise_m: float = 0.01
    range_max_m: float = 15.0
    movers: int = 0
    field_of_view_deg: float = 360.0
    ceiling: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind is {self.kind!r}; choose one of {', '.join(map(repr, get_args(Kind)))}")
        if self.dimension not in (2, 3):
            raise ValueError(f"dimension is {self.dimension!r}; choose 2 (a plane of rays) or 3 (a spinning lidar)")
        for name, least in {"scans": 2, "beams": 1, "rings": 1, "movers": 0, "seed": 0}.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise ValueError(f"{name} is {value!r}; give a whole number of at least {least}")
        for name, above in {"range_max_m": "above 0 m", "noise_m": "of at least 0 m"}.items():
            value = getattr(self, name)
            if not np.isfinite(value) or value < 0 or (value == 0 and name == "range_max_m"):
                raise ValueError(f"{name} is {value!r}; give a finite length {above}")
        if not 0 < self.field_of_view_deg <= 360:
            raise ValueError(f"field_of_view_deg is {self.field_of_view_deg!r}; give an angle above 0 and up to 360")

    def random(self, stream: str) -> np.random.Generator:
        """A generator of its own for one purpose, one of ``STREAMS``; the same for the same seed."""
        return np.random.default_rng([self.seed, STREAMS.index(stream)])

    def as_dict(self) -> dict[str, str | int | float | bool]:
        """The settings as plain values, for a file that ``WorldSettings(**...)`` can be made of again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


# A world of each dimension that a laptop scans within seconds and a mapper maps within minutes.
DEFAULTS = {2: WorldSettings(), 3: WorldSettings(dimension=3, scans=48, beams=180)}
