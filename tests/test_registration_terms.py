"""The registration terms: their definitions as loops, gradients, and what must not change them."""

import pytest
import reference
import torch
from differences import gradcheck
from scan_problems import in_the_world, random_batch, with_padding

from bbr_layer import RigidMotion
from models import REGISTRATION_TERMS, ScanBatch, TermSettings, buddy_term, edge_clouds, registration_term
from models import corrected_poses as corrected
from models.edge_clouds import misalignment

# Every term, as (name, settings). A new term is a new row.
TERMS = {
    "none": ("none", TermSettings()),
    "chamfer": ("chamfer", TermSettings()),
    "trimmed": ("trimmed_chamfer", TermSettings(keep=0.6)),
    "geman_mcclure": ("geman_mcclure_chamfer", TermSettings()),
    "softBBS": ("buddy", TermSettings(loss="softBBS")),
    "softBD": ("buddy", TermSettings(loss="softBD")),
    "N": ("buddy", TermSettings(loss="N")),
    "F": ("buddy", TermSettings(loss="F")),
    "residual": ("residual", TermSettings()),
}
ON_POINTS = [row for row in TERMS if row not in ("none", "residual")]
SPACING, OUTLIER = 0.4, 1e-10


def build(row: str, progress: float = 1.0):
    term = registration_term(*TERMS[row])
    term.set_progress(progress)
    return term


def measured(batch: ScanBatch, off: float = 0.1) -> ScanBatch:
    """The batch with normals and with measured edges that lie ``off`` away from the starting poses."""
    target, source = batch.edges.unbind(1)
    d = batch.points.shape[-1]
    relative = batch.start.item(target).inverse() @ batch.start.item(source)
    noise = off * torch.randn(len(target), d * (d + 1) // 2, dtype=torch.float64)
    normals = torch.nn.functional.normalize(torch.randn_like(batch.points), dim=-1)
    motion = RigidMotion.from_rotvec(noise[:, :-d], noise[:, -d:])
    return batch._replace(normals=normals, edge_measurement=motion @ relative)


def value(term, batch: ScanBatch, world_points=None, world_from_scan=None) -> torch.Tensor:
    """The term at the starting poses, or at those given."""
    pose = batch.start if world_from_scan is None else world_from_scan
    points = in_the_world(batch) if world_points is None else world_points
    normals = None if batch.normals is None else pose.rotate(batch.normals)
    return term(points, normals, batch.mask, pose, batch)


def ends(batch: ScanBatch, edge: int):
    """Real world points and normals of the target and of the source of one edge."""
    found = []
    for scan in batch.edges[edge].tolist():
        pose = batch.start.item(scan)
        real = batch.mask[scan]
        found.append((pose(batch.points[scan])[real], pose.rotate(batch.normals[scan])[real]))
    return found


def kernel(row: str, distances: torch.Tensor) -> torch.Tensor:
    """One side of a Chamfer distance, from the distance of each point to its nearest."""
    if row == "trimmed":
        kept = -int(-0.6 * len(distances) // 1)
        return sum(sorted(distances.tolist())[:kept]) / kept
    if row == "geman_mcclure":
        s = 2 * SPACING
        return sum(s * (r / s) ** 2 / (1 + (r / s) ** 2) for r in distances) / len(distances)
    return sum(distances) / len(distances)


def literal(row: str, batch: ScanBatch, edge: int) -> torch.Tensor:
    """The term of one edge at the end of the annealing, by loops."""
    (P, P_normals), (Q, Q_normals) = ends(batch, edge)
    D = reference.distances(P, Q)
    if row in ("chamfer", "trimmed", "geman_mcclure"):
        return kernel(row, D.min(1).values) + kernel(row, D.min(0).values)
    planes = reference.point_to_plane_distances(P, Q, P_normals, Q_normals)
    rounding = 0.2 * SPACING
    if row == "softBBS":
        smooth = (D.square() + rounding**2).sqrt()
        return reference.soft_bbs(smooth, SPACING, OUTLIER) * SPACING / min(len(P), len(Q))
    if row == "softBD":
        return reference.soft_bd((D.square() + rounding**2).sqrt(), SPACING, OUTLIER)
    if row == "N":
        return reference.soft_bd((planes.square() + rounding**2).sqrt(), SPACING, OUTLIER)
    return reference.buddy_filter(D, (planes.square() + (0.03 * SPACING) ** 2).sqrt())


def test_every_name_has_a_row_here():
    assert {name for name, _ in TERMS.values()} == set(REGISTRATION_TERMS)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("row", ON_POINTS)
def test_the_term_is_its_definition(row, d):
    batch = measured(random_batch(d))
    weights = batch.edge_weight
    expected = sum(weights[edge] * literal(row, batch, edge) for edge in range(3)) / weights.sum()
    answer = value(build(row), batch)
    assert answer.shape == ()
    torch.testing.assert_close(answer, torch.as_tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("d", [2, 3])
def test_no_term_is_zero(d):
    assert value(build("none"), measured(random_batch(d))).item() == 0


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("row", ON_POINTS)
def test_the_gradient_in_the_world_points(row, d):
    batch = measured(random_batch(d, n=7))
    term = build(row)  # at the end of the annealing, where the temperature does not follow the points
    points = in_the_world(batch).requires_grad_()
    assert gradcheck(lambda x: value(term, batch, x), (points,))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("informed", [False, True])
def test_the_gradient_of_the_residual_in_the_corrections(informed, d):
    batch = measured(random_batch(d))
    if informed:
        factor = torch.randn(3, d * (d + 1) // 2, 8, dtype=torch.float64)
        batch = batch._replace(edge_information=factor @ factor.mT)
    correction = (0.1 * torch.randn(3, d * (d + 1) // 2, dtype=torch.float64)).requires_grad_()
    term = build("residual")

    def at(x: torch.Tensor) -> torch.Tensor:
        return value(term, batch, world_from_scan=corrected(batch, x, 0.5))

    assert gradcheck(at, (correction,))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("progress", [0.0, 0.5])
@pytest.mark.parametrize("row", [*ON_POINTS, "residual"])
def test_padding_is_removal_whatever_it_holds(row, progress, d):
    batch = measured(random_batch(d))
    full = batch._replace(mask=torch.ones_like(batch.mask))
    padded = with_padding(full, 3, torch.nan)
    term = build(row, progress)
    points = torch.cat((in_the_world(full), torch.full((3, 3, d), torch.nan, dtype=torch.float64)), 1)
    points.requires_grad_()
    answer = value(term, padded, points)
    torch.testing.assert_close(answer, value(term, full))
    if row != "residual":
        answer.backward()
        assert torch.equal(points.grad[:, -3:], torch.zeros(3, 3, d, dtype=torch.float64))
        assert points.grad.isfinite().all()


@pytest.mark.parametrize("row", [*ON_POINTS, "residual"])
def test_spacing_and_normals_are_found_when_not_given(row):
    batch = measured(random_batch(2, n=20))._replace(spacing=None)
    without = batch._replace(normals=None)
    given = batch._replace(normals=without.known_normals(), spacing=without.known_spacing())
    torch.testing.assert_close(value(build(row), without), value(build(row), given))


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("row", [*ON_POINTS, "residual"])
def test_the_world_and_its_unit_do_not_matter(row, d):
    batch = measured(random_batch(d))
    turn = torch.full((3, d * (d - 1) // 2), 0.7, dtype=torch.float64)
    there = RigidMotion.from_rotvec(turn, torch.full((3, d), 100.0, dtype=torch.float64))
    moved = batch._replace(start=there @ batch.start)
    term = build(row, 0.5)
    torch.testing.assert_close(value(term, moved), value(term, batch))
    scaled = batch._replace(
        points=1000 * batch.points,
        start=batch.start._replace(translation=1000 * batch.start.translation),
        spacing=1000 * batch.spacing,
        edge_measurement=batch.edge_measurement._replace(translation=1000 * batch.edge_measurement.translation),
    )
    torch.testing.assert_close(value(term, scaled), 1000 * value(term, batch))


@pytest.mark.parametrize("row", [*ON_POINTS, "residual"])
def test_edges_without_weight_and_empty_scans_count_nothing(row):
    batch = measured(random_batch(2))
    term = build(row, 0.5)
    first = batch._replace(
        edges=batch.edges[:1],
        edge_weight=batch.edge_weight[:1],
        edge_measurement=batch.edge_measurement.item(slice(1)),
    )
    alone = value(term, first)
    weightless = batch._replace(edge_weight=torch.tensor([3.0, 0.0, 0.0], dtype=torch.float64))
    torch.testing.assert_close(value(term, weightless), alone)
    mask = batch.mask.clone()
    mask[2] = False
    torch.testing.assert_close(value(term, batch._replace(mask=mask)), alone)


@pytest.mark.parametrize("row", [*ON_POINTS, "residual"])
def test_no_edges_is_zero_with_a_gradient_of_zero(row):
    batch = random_batch(2)
    nothing = batch._replace(
        edges=torch.zeros(0, 2, dtype=torch.int64),
        edge_weight=torch.zeros(0, dtype=torch.float64),
        edge_measurement=RigidMotion.identity(2, (0,)),
    )
    points = in_the_world(batch).requires_grad_()
    translation = batch.start.translation.clone().requires_grad_()
    answer = value(build(row, 0.5), nothing, points, batch.start._replace(translation=translation))
    assert answer.item() == 0
    answer.backward()
    assert not (points.grad if row != "residual" else translation.grad).any()


@pytest.mark.parametrize("progress", [0.0, 1.0])
@pytest.mark.parametrize("row", ON_POINTS)
def test_scans_that_coincide_have_a_finite_gradient(row, progress):
    batch = measured(random_batch(3))
    points = batch.points[:1].expand(3, -1, -1).clone().requires_grad_()
    answer = value(build(row, progress), batch, points)
    answer.backward()
    assert answer.isfinite()
    assert points.grad.isfinite().all()


@pytest.mark.parametrize("row", ON_POINTS)
def test_pieces_are_the_whole(row, monkeypatch):
    batch = measured(random_batch(2))
    term = build(row, 0.5)

    def run() -> tuple[torch.Tensor, torch.Tensor]:
        points = in_the_world(batch).requires_grad_()
        answer = value(term, batch, points)
        answer.backward()
        return answer, points.grad

    whole = run()
    monkeypatch.setattr(buddy_term, "PAIRS_PER_PIECE", 1)
    monkeypatch.setattr(edge_clouds, "PAIRS_PER_TILE", 30)
    torch.testing.assert_close(run(), whole)


def test_temperatures_fall_from_the_misalignment_to_the_spacing():
    cooling = edge_clouds.Cooling(1.0, 2.0)
    misaligned, spacing = torch.tensor([5.0, 0.1]).double(), torch.tensor([0.4, 0.4]).double()
    torch.testing.assert_close(cooling.at(0.0, misaligned, spacing), torch.tensor([5.0, 0.8]).double())
    torch.testing.assert_close(cooling.at(0.5, misaligned, spacing), torch.tensor([2.0, 0.8]).double())
    torch.testing.assert_close(cooling.at(1.0, misaligned, spacing), torch.tensor([0.8, 0.8]).double())


@pytest.mark.parametrize("row", ["geman_mcclure", "softBBS", "softBD", "N", "F"])
def test_annealed_terms_listen_to_the_progress(row):
    batch = measured(random_batch(2))._replace(spacing=torch.full((3,), 0.01, dtype=torch.float64))
    assert not torch.allclose(value(build(row, 0.0), batch), value(build(row, 1.0), batch))


@pytest.mark.parametrize(
    ("name", "settings", "words"),
    [
        ("icp", TermSettings(), "one of none, chamfer"),
        ("buddy", TermSettings(loss="bbs"), "one of softBBS, softBD, N, F"),
        ("buddy", TermSettings(start=0.0), "start is 0.0"),
        ("geman_mcclure_chamfer", TermSettings(end=-1.0), "end is -1.0"),
        ("trimmed_chamfer", TermSettings(keep=0.0), "keep is 0.0"),
    ],
)
def test_wrong_settings_are_refused_in_words(name, settings, words):
    with pytest.raises(ValueError, match=words):
        registration_term(name, settings)


@pytest.mark.parametrize("row", ["geman_mcclure", "softBD"])
def test_progress_beyond_the_end_is_refused_in_words(row):
    with pytest.raises(ValueError, match="fraction is 1.5"):
        build(row, 1.5)


def test_the_misalignment_has_no_gradient():
    distances = torch.rand(2, 5, requires_grad=True)
    assert not misalignment(distances, torch.ones(2, 5, dtype=torch.bool)).requires_grad


@pytest.mark.parametrize("row", ["geman_mcclure", "softBBS", "softBD", "N", "F"])
def test_scans_each_in_one_place_have_a_finite_term(row):
    batch = measured(random_batch(2))
    batch = batch._replace(points=batch.points[:, :1].expand_as(batch.points).clone(), spacing=None)
    assert value(build(row, 1.0), batch).isfinite()
