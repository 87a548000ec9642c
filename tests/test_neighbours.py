"""The neighbours are those of brute force at every motion, whatever was asked before, and margins save look-ups."""

import copy
import math

import numpy as np
import pytest
import torch
from problems import motion, noisy_pair, unit
from torch import Tensor

from bbr_layer import Adam, BBRLayer, CloudPair, Detached, RigidMotion, estimate_normals, margins
from bbr_layer.neighbourhoods import nearest_neighbours
from bbr_layer.neighbours import MutualNeighbours
from bbr_layer.searches import search_of
from bbr_layer.spacing import SPACING_POINTS, point_spacing
from bbr_layer.tiles import nearest_by_tiles


def first_nearest(queries: Tensor, points: Tensor) -> Tensor:
    """Of all points the nearest to each query by explicit float64 distances, the first of equally near ones."""
    offsets = queries[:, None].double() - points.double()
    squared = offsets[..., 0] ** 2
    for axis in range(1, offsets.shape[-1]):
        squared = squared + offsets[..., axis] ** 2
    return squared.argmin(1)


def by_brute_force(clouds: tuple[Tensor | None, ...], at: RigidMotion) -> tuple[Tensor, Tensor]:
    """What ``MutualNeighbours(*clouds)(at)`` must answer."""
    P, Q, P_mask, Q_mask = clouds
    nearest, mutual = torch.zeros(Q.shape[:2], dtype=torch.int64), torch.zeros(Q.shape[:2], dtype=torch.bool)
    for b in range(P.shape[0]):
        rows, columns = (
            torch.arange(x.shape[1]) if mask is None else mask[b].nonzero()[:, 0]
            for x, mask in ((P, P_mask), (Q, Q_mask))
        )
        if not len(rows) or not len(columns):
            continue
        p, q, here = P[b, rows].double(), Q[b, columns].double(), at.item(b)
        index = first_nearest(here(q), p)
        back = first_nearest(here.inverse()(p), q)
        nearest[b, columns] = rows[index]
        mutual[b, columns] = back[index] == torch.arange(len(columns))
    return nearest, mutual


def assert_brute_force(clouds: tuple[Tensor | None, ...], motions: list[RigidMotion]) -> MutualNeighbours:
    """The same pairs at every motion in turn, and backwards, by one search; answers with that search."""
    search = MutualNeighbours(*clouds)
    for at in [*motions, *reversed(motions), motions[0], motions[-1]]:
        for found, wanted in zip(search(at), by_brute_force(clouds, at), strict=True):
            assert torch.equal(found, wanted)
    return search


def converging(d: int, batch: int, steps: int = 30) -> list[RigidMotion]:
    """Motions that swing about a known one, ever less, as Adam's do."""
    truth = motion(d)
    found = []
    for step in range(steps):
        away = 0.5 * 0.7**step * math.cos(2.0 * step)
        near = motion(d, angle=away, shift=away) @ truth
        found.append(RigidMotion(near.rotation.expand(batch, d, d), near.translation.expand(batch, d)))
    return found


@pytest.fixture(params=["compiled", "compiled as for large clouds", "plain"], autouse=True)
def arithmetic(request, monkeypatch) -> None:
    """Every test with the compiled walk from neighbour to neighbour, whole or with a tree behind it, and without."""
    monkeypatch.setattr("bbr_layer.margins.COMPILED", request.param != "plain")
    if request.param != "compiled":
        monkeypatch.setattr("bbr_layer.margins.SMALL", 0)


@pytest.fixture
def taken(monkeypatch) -> list[RigidMotion]:
    """The motions that a registration asks neighbours for, as it goes."""
    asked: list[RigidMotion] = []
    answer = MutualNeighbours.of_item

    def spy(self: MutualNeighbours, number: int, pose: tuple[np.ndarray, np.ndarray]):
        d = self.items[number].forth.tree.points.shape[1]
        asked.append(RigidMotion(*(torch.tensor(x[None, :d]) for x in (pose[0][:, :d], pose[1]))))
        return answer(self, number, pose)

    monkeypatch.setattr(MutualNeighbours, "of_item", spy)
    monkeypatch.setattr(MutualNeighbours, "tables", lambda self, number: None)  # or compiled code asks unseen
    return asked


def shifted(rotation: list[list[float]], translation: list[float]) -> RigidMotion:
    """A motion of exact numbers, batch of one."""
    return RigidMotion(torch.tensor([rotation], dtype=torch.float64), torch.tensor([translation], dtype=torch.float64))


@pytest.mark.parametrize("d", [2, 3])
def test_pairs_of_a_registration_are_those_of_brute_force_at_every_step(d, taken):
    cloud = torch.rand(1, 300, d, dtype=torch.float64)
    P, Q = cloud[:, :250], motion(d, 0.1, 0.05).inverse()(cloud[:, 50:])
    Q = Q + 0.01 * torch.randn_like(Q)
    normals = unit(torch.randn(1, 300, d, dtype=torch.float64))
    layer = BBRLayer("F", inner=Adam(40, 0.02), backward=Detached())
    layer(P, Q, P_normals=normals[:, :250], Q_normals=normals[:, 50:])
    motions = list(taken)
    assert len(motions) >= 40
    search = assert_brute_force((P, Q, None, None), motions)
    assert search.looked_up < search.asked


@pytest.mark.parametrize("d", [2, 3])
def test_compiled_steps_are_those_that_ask_for_their_pairs_one_by_one(d, monkeypatch):
    cloud = torch.rand(2, 60, d, dtype=torch.float64)
    given = {"P_mask": torch.rand(2, 60) < 0.8, "Q_mask": torch.rand(2, 60) < 0.8}
    answers = []
    for whole in (True, False):
        if not whole:
            monkeypatch.setattr(MutualNeighbours, "tables", lambda self, number: None)
        P = cloud.clone().requires_grad_()
        found = BBRLayer("F", inner=Adam(20, 0.02))(P, motion(d, 0.1).inverse()(cloud), **given).target_from_source
        answers.append((found.matrix, *torch.autograd.grad(found.matrix.square().sum(), P)))
    for one, other in zip(*answers, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


def test_pairs_of_real_scans_are_those_of_brute_force_at_every_step(real_data, taken):
    scans = np.load(real_data / "pair_kitti00_95_94.npz")
    P, Q = (torch.from_numpy(scans[name][::150])[None] for name in ("tgt", "src"))
    layer = BBRLayer("F", inner=Adam(40, 0.02), backward=Detached())
    layer(P, Q, P_normals=estimate_normals(P), Q_normals=estimate_normals(Q))
    motions = list(taken)[::3]
    assert_brute_force((P - P.mean(1, keepdim=True), Q - Q.mean(1, keepdim=True), None, None), motions)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_masks_and_empty_items(d, dtype):
    given = noisy_pair(d, batch=4, n=40, m=50)
    P, Q = given["P"].to(dtype), given["Q"].to(dtype)
    P_mask, Q_mask = torch.rand(4, 40) < 0.7, torch.rand(4, 50) < 0.7
    P_mask[1], Q_mask[2] = False, False
    P_mask[3], Q_mask[3] = torch.arange(40) == 7, torch.arange(50) == 9
    P[~P_mask], Q[~Q_mask] = torch.nan, torch.nan
    assert_brute_force((P, Q, P_mask, Q_mask), converging(d, 4))
    assert_brute_force((P.nan_to_num(), Q, None, Q_mask), converging(d, 4))


def test_an_empty_batch():
    search = MutualNeighbours(torch.zeros(0, 3, 3), torch.zeros(0, 5, 3))
    nearest, mutual = search(RigidMotion.identity(3, (0,)))
    assert nearest.shape == mutual.shape == (0, 5) and search.asked == 0


@pytest.mark.parametrize("d", [2, 3])
def test_duplicates(d):
    given = noisy_pair(d, n=30, m=30)
    P, Q = (given[name][:, torch.randint(30, (100,))] for name in ("P", "Q"))
    assert_brute_force((P, Q, None, None), converging(d, 1))


@pytest.mark.parametrize("d", [2, 3])
def test_ties_go_to_the_first(d):
    side = torch.arange(5.0, dtype=torch.float64)
    grid = torch.cartesian_prod(*[side] * d)
    P, Q = grid[torch.randperm(len(grid))][None], grid[torch.randperm(len(grid))][None]
    still = torch.eye(d).tolist()
    quarter = torch.eye(d)
    quarter[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    halves = [[0.5] * d, [0.5] + [0.0] * (d - 1), [0.25] * d, [0.0] * d, [-0.5] * d, [2.5] * d]
    motions = [shifted(turn, shift) for shift in halves for turn in (still, quarter.tolist())]
    assert_brute_force((P, Q, None, None), motions)
    assert_brute_force((P.repeat(1, 3, 1), Q.repeat(1, 2, 1), None, None), motions)


def test_a_cloud_that_is_one_point():
    one, many = torch.ones(1, 200, 3, dtype=torch.float64), torch.rand(1, 50, 3, dtype=torch.float64)
    for P, Q in ((one, many), (many, one), (one, one), (one[:, :1], many), (many, one[:, :1])):
        assert_brute_force((P, Q, None, None), converging(3, 1, steps=5))


def test_clouds_far_apart_and_far_from_the_origin():
    P, Q = 1e3 + torch.rand(1, 60, 3, dtype=torch.float64), torch.rand(1, 70, 3, dtype=torch.float64) - 1e3
    assert_brute_force((P, Q, None, None), converging(3, 1))
    there = shifted(torch.eye(3).tolist(), [2e3] * 3)
    assert_brute_force((P, Q, None, None), [there @ at for at in converging(3, 1)])


def test_a_motion_that_is_not_finite_breaks_nothing():
    given = noisy_pair(3)
    search = MutualNeighbours(given["P"], given["Q"])
    nearest, _ = search(shifted(torch.eye(3).tolist(), [torch.nan] * 3))
    assert ((nearest >= 0) & (nearest < given["P"].shape[1])).all()
    at = converging(3, 1)[-1]
    assert torch.equal(search(at)[0], by_brute_force((given["P"], given["Q"], None, None), at)[0])


def test_margins_save_look_ups_on_the_way_and_change_no_answer():
    cloud = torch.rand(1, 500, 3, dtype=torch.float64)
    P, Q = cloud, motion(3).inverse()(cloud + 0.01 * torch.randn_like(cloud))
    kept, dropped = MutualNeighbours(P, Q), MutualNeighbours(P, Q, margins=False)
    for at in converging(3, 1):
        assert all(torch.equal(a, b) for a, b in zip(kept(at), dropped(at), strict=True))
    assert kept.asked == dropped.asked == dropped.looked_up
    assert kept.looked_up < 0.6 * kept.asked
    before = kept.looked_up
    kept(converging(3, 1)[-1])
    assert kept.looked_up == before  # nothing moved, nothing is looked up


def test_neighbours_of_a_drift_are_walked_to():
    cloud = torch.rand(1, 500, 3, dtype=torch.float64)
    search = MutualNeighbours(cloud, cloud + 1e-3)
    still = torch.eye(3).tolist()
    drift = [shifted(still, [0.02 * step, 0.0, 0.0]) for step in range(20)]
    for at in drift:
        for found, wanted in zip(search(at), by_brute_force((cloud, cloud + 1e-3, None, None), at), strict=True):
            assert torch.equal(found, wanted)
    assert search.looked_up < 0.5 * search.searched or not margins.COMPILED


def test_only_chosen_targets_are_looked_up_in_the_source():
    P = torch.rand(1, 400, 3, dtype=torch.float64)
    search = MutualNeighbours(P, P[:, :30] + 1e-3)
    search(RigidMotion.identity(3, (1,)))
    assert search.asked <= 60


def test_a_copy_searches_on():
    given = noisy_pair(3, n=50, m=60)
    clouds = (given["P"].repeat(1, 2, 1), given["Q"], None, None)
    search = MutualNeighbours(*clouds)
    motions = converging(3, 1, steps=6)
    search(motions[0])
    twin = copy.deepcopy(search)
    for at in motions:
        for a, b, wanted in zip(search(at), twin(at), by_brute_force(clouds, at), strict=True):
            assert torch.equal(a, b) and torch.equal(a, wanted)


def test_tiles_find_the_same(monkeypatch):
    monkeypatch.setattr("bbr_layer.tiles.PAIRS_PER_TILE", 100)
    queries, points = torch.rand(33, 3, dtype=torch.float64), torch.rand(21, 3, dtype=torch.float64)
    assert torch.equal(nearest_by_tiles(queries, points), first_nearest(queries, points))


@pytest.mark.parametrize("d", [2, 3, 5])
def test_neighbours_within_a_cloud(d):
    points = torch.rand(2, 30, d, dtype=torch.float64)
    mask = torch.ones(2, 30, dtype=torch.bool)
    mask[1, 3:] = False
    found = nearest_neighbours(points, 4, mask)
    assert torch.equal(found[0], torch.cdist(points[0], points[0]).argsort(1)[:, :4])
    assert torch.equal(found[1, :3], torch.cdist(points[1, :3], points[1, :3]).argsort(1)[:, [0, 1, 2, 2]])


def test_spacing_of_a_large_cloud_is_measured_on_some_points_against_all():
    side = torch.arange(100.0, dtype=torch.float64)
    points = torch.cartesian_prod(side, side)[torch.randperm(10_000)].requires_grad_()
    assert len(points) > SPACING_POINTS
    spacing = point_spacing(points)
    assert spacing.item() == 1.0
    assert torch.autograd.grad(spacing, points)[0].isfinite().all()
    padded = torch.cat((points, torch.full((500, 2), torch.nan)))[None]
    mask = (torch.arange(10_500) < 10_000)[None]
    assert torch.equal(point_spacing(padded, mask)[0], spacing)


def test_a_cloud_that_is_written_to_is_searched_anew():
    P, Q = (torch.rand(1, 40, 3, dtype=torch.float64) for _ in range(2))
    still = RigidMotion.identity(3, (1,))
    pair, normals = CloudPair(P, Q), estimate_normals(P)
    before = search_of(pair)(still)[0]
    assert search_of(pair) is search_of(CloudPair(P, Q))
    P.copy_(torch.rand_like(P))
    after = search_of(pair)(still)[0]
    assert torch.equal(after, by_brute_force((P, Q, None, None), still)[0]) and not torch.equal(after, before)
    assert torch.equal(estimate_normals(P), estimate_normals(P.clone())) and not torch.equal(
        estimate_normals(P), normals
    )


def test_a_listed_point_that_is_nearer_denies_the_pair_without_a_look_up():
    if not margins.COMPILED:
        pytest.skip("without Numba nothing is listed")
    P, Q = torch.rand(1, 300, 3, dtype=torch.float64), torch.rand(1, 400, 3, dtype=torch.float64)
    search = MutualNeighbours(P, Q)
    for at in converging(3, 1):
        search(at)
    back = search.items[0].back
    assert 0 < back.looked_up < 0.1 * back.searched  # 48 and 75 of 1723; 280 and 300 where nothing is denied


def test_the_spacing_of_many_points_is_asked_all_over_their_order():
    along = torch.cat((0.01 * torch.arange(4500), 100 + torch.arange(5500.0)))  # dense first, sparse the more
    assert point_spacing(torch.stack((along, torch.zeros_like(along)), 1)).item() == pytest.approx(1.0, rel=1e-3)


def test_exact_duplicates_are_looked_past_in_a_spacing():
    points = torch.rand(50, 3, dtype=torch.float64)
    assert torch.equal(point_spacing(points.repeat(3, 1)), point_spacing(points))
