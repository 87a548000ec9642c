"""What a scan must be like to be mapped, which of its points are left out, and in which sentence it is refused."""

import numpy as np
import pytest
from map_problems import square_room

from bbr_layer import read_scans
from train.scan_checks import check_scan, without_far_points, without_height

REAL_SEQUENCES = (
    *("3dmatch_kitchen_0_1_4_5", "balm_realworld_30-108", "deepmapping2d_v1_pose0", "iclnuim_livingroom_0-120"),
    *("kitti00_0-15", "kitti07_submaps_gtsam", "radish2d_intel", "stanford_bunny", "stanford_dragon", "tum_fr1_desk_5"),
)


def test_a_scan_beside_its_origin_is_taken_and_one_on_a_map_of_a_country_is_not():
    room = square_room(np.zeros(2))
    for beside in (0.0, 2.0, 1000.0):
        check_scan("a.las", room + beside)
    with pytest.raises(ValueError, match=r"scan a.las lies 5.02494e\+06 from its origin and is about 2.\d* wide"):
        check_scan("a.las", room + [5e5, 5e6])


def test_points_too_far_to_have_been_seen_go_and_are_told(rng):
    rooms = [square_room(place) for place in rng.uniform(-1, 1, size=(8, 2))]
    far = [np.insert(room, 90, [1e4, 65535.0], axis=0) if n != 3 else room for n, room in enumerate(rooms)]
    far[1][5] = [1e300, 1.0]  # whose square overflows
    names = [f"{number}.csv" for number in range(8)]
    kept, notes = without_far_points(far, names)
    for number, room in enumerate(rooms):
        assert np.array_equal(kept[number], room if number != 1 else np.delete(room, 5, axis=0))
    assert len(notes) == 1 and notes[0].startswith("points that lie farther than 2")
    assert notes[0].endswith("1 in 0.csv, 2 in 1.csv, 1 in 2.csv, 1 in 4.csv, 1 in 5.csv and 2 more")


def test_scans_without_such_points_stay_as_they_are():
    rooms = [square_room(np.zeros(2)), np.zeros((4, 2)), 20 * square_room(np.zeros(2))]
    kept, notes = without_far_points(rooms, list("abc"))
    assert notes == [] and all(one is other for one, other in zip(kept, rooms, strict=True))
    assert without_far_points([np.zeros((4, 3))] * 2, list("ab"))[1] == []


def test_a_scan_that_would_hardly_keep_a_point_is_refused():
    room = square_room(np.zeros(2))
    with pytest.raises(ValueError, match=r"of the 180 points of scan b 180 lie farther than .* the unit of the others"):
        without_far_points([room, 1000 * room, room, room, room], list("abcde"))


@pytest.mark.parametrize("name", REAL_SEQUENCES)
def test_real_sequences_lose_no_point(real_data, name):
    scans = [cloud.points for cloud in read_scans(real_data / f"seq_{name}.npz")]
    kept, notes = without_far_points(scans, [str(number) for number in range(len(scans))])
    assert notes == [] and all(one is other for one, other in zip(kept, scans, strict=True))
    for scan in scans:
        check_scan(name, scan)


@pytest.mark.parametrize(("height", "shaken"), [(0.3, 0.0), (0.3, 3e-7), (0.0, 1e-9), (-12.5, 1e-9)])
def test_points_at_one_height_are_planar_and_the_height_is_told(rng, height, shaken):
    rooms = [square_room(place) for place in rng.uniform(-1, 1, size=(3, 2))]
    heights = [height + shaken * rng.uniform(-1, 1, size=len(room)) for room in rooms]
    flat, notes = without_height([np.column_stack(both) for both in zip(rooms, heights, strict=True)])
    assert all(np.array_equal(one, room) for one, room in zip(flat, rooms, strict=True))
    assert len(notes) == 1 and "all points lie at z = " in notes[0]


def test_planar_scans_are_not_spoken_of_and_heights_that_differ_stay(rng):
    room = square_room(np.zeros(2))
    at_zero = np.column_stack((room, np.zeros(len(room))))
    assert without_height([at_zero, room])[0][0].shape == room.shape and without_height([at_zero, room])[1] == []
    for other in (at_zero + [0, 0, 1e-4], at_zero + 1e-4 * rng.normal(size=(len(room), 1))):
        kept, notes = without_height([at_zero, other])
        assert kept[1] is other and notes == []


def test_returns_of_nothing_do_not_make_what_was_seen_far():
    scan = np.concatenate((np.zeros((100, 2)), 1 + np.random.default_rng(0).random((20, 2))))
    assert without_far_points([scan, scan], ["a", "b"])[1] == []
