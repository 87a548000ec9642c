"""The benchmark of growth: the beginnings of a log, and its table."""

import numpy as np
import pytest
from small_worlds import small_world

from benchmarks import growth
from train.scans import ScanSet


def test_the_beginning_of_a_log_keeps_its_starting_poses():
    scans = small_world()
    log = ScanSet(scans.points, scans.names, scans.timestamps, start=scans.truth)
    first = growth.beginning(log, 3)
    assert len(first) == 3 and first.points[2] is log.points[2]
    np.testing.assert_array_equal(first.start, scans.truth[:3])


@pytest.mark.parametrize("counts", [(30, 115), (115, 30)])
def test_the_table_of_growth_begins_with_the_shortest(counts):
    one = {"edges": 50, "CPU seconds": 4.0, "before": 5e8, "peak": 9e8}
    lines = growth.table({str(count): one for count in counts}).splitlines()[-2:]
    assert lines == ["| 30 | 50 | 4 | 0.080 | 900 | 500 |", "| 115 | 50 | 4 | 0.080 | 900 | 500 |"]
