"""An occupancy grid as the ROS map_server reads it: a grey picture and a few lines of YAML."""

from pathlib import Path

import numpy as np
import yaml
from jaxtyping import UInt8
from PIL import Image

from bbr_layer import atomic_write
from train.occupancy_grid import OccupancyGrid

# The grey values and thresholds that map_saver writes; (255 - 205) / 255 = 0.19608 stays above free_thresh, as it
# must for the unknown to be read back as unknown.
OCCUPIED, FREE, UNKNOWN = 0, 254, 205
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.196


def map_image(grid: OccupancyGrid) -> UInt8[np.ndarray, "rows columns"]:
    """Black where occupied, nearly white where free, grey where unknown or undecided; the first row is the top."""
    probability = grid.probability
    image = np.full(probability.shape, UNKNOWN, dtype=np.uint8)
    image[probability >= OCCUPIED_THRESHOLD] = OCCUPIED
    image[grid.observed & (probability < 0.5)] = FREE
    return image[::-1]


def write_ros_map(path: str | Path, grid: OccupancyGrid) -> None:
    """Write ``NAME.png`` and, beside it, ``NAME.yaml``, which names it; ``path`` is that of the picture.

    Source: the map_server package of ROS, wiki.ros.org/map_server, section "Map format".
    """
    picture = Path(path)
    description = {
        "image": picture.name,
        "resolution": grid.resolution,
        "origin": [*grid.origin, 0.0],
        "negate": 0,
        "occupied_thresh": OCCUPIED_THRESHOLD,
        "free_thresh": FREE_THRESHOLD,
    }
    with atomic_write(picture) as temporary:
        Image.fromarray(map_image(grid)).save(temporary, format="PNG", optimize=True)
    with atomic_write(picture.with_suffix(".yaml")) as temporary:
        temporary.write_text(yaml.safe_dump(description, sort_keys=False), encoding="utf-8")
