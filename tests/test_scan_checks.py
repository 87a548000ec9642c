"""What a scan must be like to be mapped, and in which sentence it is refused otherwise."""

import numpy as np
import pytest
from map_problems import square_room

from train.scan_checks import check_scan


def test_a_scan_beside_its_origin_is_taken_and_one_on_a_map_of_a_country_is_not():
    room = square_room(np.zeros(2))
    for beside in (0.0, 2.0, 1000.0):
        check_scan("a.las", room + beside)
    with pytest.raises(ValueError, match=r"scan a.las lies 5.02494e\+06 from its origin and is about 2.\d* wide"):
        check_scan("a.las", room + [5e5, 5e6])
