"""Wrong loops as the benchmark makes them: as many as asked, wrong, and where they are to agree, agreeing."""

import pytest
from small_worlds import small_world, true_edges, true_poses

from benchmarks.false_loops import GROUP, Wrong, wrong_loops
from train.pose_graph import Edges


def _with_loops() -> Edges:
    edges = true_edges(small_world())
    kind = edges.kind.clone()
    kind[-12:] = 2
    return edges._replace(kind=kind)


def _off(loops: Edges) -> list[float]:
    poses = true_poses(small_world())
    truth = poses.item(loops.target).inverse() @ poses.item(loops.source)
    return (truth.translation - loops.target_from_source.translation).norm(dim=-1).tolist()


@pytest.mark.parametrize(("share", "count"), [(0.25, 4), (0.5, 12)])
@pytest.mark.parametrize("kind", ["scattered", "agreeing"])
def test_wrong_loops_are_the_share_of_all_loops_and_wrong(share, count, kind):
    loops = wrong_loops(_with_loops(), true_poses(small_world()), 4.0, Wrong(share, kind, 0))
    assert len(loops.target) == count == round(share * (12 + count))
    assert (loops.kind == 2).all() and (loops.source > loops.target).all()
    assert min(_off(loops)) > 0.5


def test_agreeing_loops_lead_to_one_place():
    poses = true_poses(small_world())
    loops = wrong_loops(_with_loops(), poses, 4.0, Wrong(0.25, "agreeing", 0))
    assert len(loops.target) == GROUP
    # where each says the first source scan stands, seen from the first target scan
    to_first = poses.item(loops.target * 0 + loops.target[0]).inverse() @ poses.item(loops.target)
    back = poses.item(loops.source).inverse() @ poses.item(loops.source * 0 + loops.source[0])
    said = (to_first @ loops.target_from_source @ back).matrix
    assert (said - said[0]).abs().max() < 1e-9
    scattered = wrong_loops(_with_loops(), poses, 4.0, Wrong(0.25, "scattered", 0))
    assert len({round(x, 6) for x in _off(scattered)}) == 4
