"""The command line: two files registered, the answer for people and for programs, and what bad input is told."""

import io
import json
import subprocess
import sys

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from bbr_layer import read_cloud, write_cloud
from bbr_layer.__main__ import app
from bbr_layer.answer import _plain, described, show, write_moved
from bbr_layer.clouds import Cloud
from bbr_layer.directions import Direction
from bbr_layer.two_clouds import _stages, common_dimension, register_clouds

# Whole points of each cloud are fewer than the command's default, so that the tests are fast.
COUNT = 200


@pytest.fixture
def motion():
    target_from_source = np.eye(4)
    target_from_source[:3, :3] = Rotation.from_rotvec([0.1, -0.15, 0.2]).as_matrix()
    target_from_source[:3, 3] = [0.3, -0.1, 0.2]
    return target_from_source


def surface(rng, count):
    """A bowl with a bump: a surface that holds every motion."""
    x, y = rng.uniform(-1, 1, size=(2, count))
    return np.stack((x, y, 0.5 * x**2 + 0.3 * y**2 + 0.4 * np.exp(-8 * ((x - 0.4) ** 2 + (y + 0.3) ** 2))), axis=1)


@pytest.fixture
def files(tmp_path, rng, motion):
    """Two samplings of one surface, the second in a frame of its own."""
    write_cloud(tmp_path / "target.ply", surface(rng, COUNT))
    inverse = np.linalg.inv(motion)
    source = surface(rng, COUNT) @ inverse[:3, :3].T + inverse[:3, 3]
    write_cloud(tmp_path / "source.xyz", source, columns={"intensity": np.arange(COUNT)})
    return str(tmp_path / "target.ply"), str(tmp_path / "source.xyz")


def run(*arguments):
    return CliRunner().invoke(app, ["register", *map(str, arguments)], catch_exceptions=False)


def refused(*arguments):
    """The sentence on stderr of a call that must end with exit code 2 and an empty stdout."""
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


@pytest.mark.parametrize("loss", ["default", "softBBS", "softBD", "N", "F"])
def test_json_holds_the_answer_and_nothing_else(files, motion, loss):
    result = run(*files, "--json", "--loss", loss)
    assert result.exit_code == 0
    assert result.stderr == ""
    answer = json.loads(result.stdout)
    found = np.array(answer["target_from_source"])
    off = Rotation.from_matrix(found[:3, :3].T @ motion[:3, :3]).magnitude()
    assert np.degrees(off) < (1.0 if loss == "default" else 4.0)
    assert np.abs(found[:3, 3] - motion[:3, 3]).max() < 0.05
    assert answer["rotation_angle_deg"] == pytest.approx(np.degrees(0.2693), abs=4.0)
    assert answer["translation"] == found[:3, 3].tolist()
    assert answer["buddy_share"] == answer["buddies"] / COUNT
    assert answer["points_read"] == {"target": COUNT, "source": COUNT}


def test_people_read_the_motion_the_pairs_and_a_verdict(files):
    result = run(*files)
    assert result.exit_code == 0
    for words in ("target_from_source", "rotation", "deg", "converged", "best buddies", "RMS", "weakest direction"):
        assert words in result.stdout
    assert "Trustworthy: " in result.stdout
    rows = [line.split() for line in result.stdout.splitlines()[1:5]]
    assert np.array(rows, dtype=float)[3].tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize("preset", ["default", "fast", "robust"])
def test_presets_find_the_motion_and_find_it_again(files, motion, preset):
    first, again = (run(*files, "--json", "--points", 100, "--preset", preset).stdout for _ in range(2))
    assert first == again
    found = np.array(json.loads(first)["target_from_source"])
    assert np.degrees(Rotation.from_matrix(found[:3, :3].T @ motion[:3, :3]).magnitude()) < 1.0


def test_the_moved_source_lies_on_the_target(files, tmp_path, motion):
    result = run(*files, "--out", tmp_path / "moved.ply")
    moved, source = read_cloud(tmp_path / "moved.ply"), read_cloud(files[1])
    expected = source.points @ motion[:3, :3].T + motion[:3, 3]
    assert np.abs(moved.points - expected).max() < 0.05
    np.testing.assert_array_equal(moved.intensity, np.arange(COUNT))
    assert "moved.ply" in result.stdout.replace("\n", "")


def test_a_start_near_the_answer_saves_a_half_turn(tmp_path, rng):
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    write_cloud(tmp_path / "target.npz", surface(rng, COUNT))
    write_cloud(tmp_path / "source.npz", surface(rng, COUNT) @ half_turn[:3, :3])
    np.savetxt(tmp_path / "start.txt", half_turn)
    arguments = (tmp_path / "target.npz", tmp_path / "source.npz", "--json", "--loss", "F")
    guided = json.loads(run(*arguments, "--start", tmp_path / "start.txt").stdout)
    assert np.abs(np.array(guided["target_from_source"]) - half_turn).max() < 0.05
    assert guided["trustworthy"]
    alone = json.loads(run(*arguments).stdout)
    assert not alone["trustworthy"]
    assert alone["sentence"].startswith("Do not trust this")


def test_clouds_of_the_plane(tmp_path, rng):
    x = rng.uniform(-1, 1, size=(2, COUNT))
    target, source = (np.stack((c, 0.5 * c**2 + 0.2 * np.sin(4 * c)), axis=1) for c in x)
    turn = Rotation.from_euler("z", 5, degrees=True).as_matrix()[:2, :2]
    write_cloud(tmp_path / "target.csv", target)
    write_cloud(tmp_path / "source.ply", source @ turn + [0.1, 0.0])  # a .ply has z = 0
    start = np.eye(3)
    np.savetxt(tmp_path / "start.txt", start)
    answer = json.loads(
        run(tmp_path / "target.csv", tmp_path / "source.ply", "--json", "--start", tmp_path / "start.txt").stdout
    )
    found = np.array(answer["target_from_source"])
    np.testing.assert_array_equal(found[2], [0, 0, 1, 0])
    assert np.degrees(np.arctan2(found[1, 0], found[0, 0])) == pytest.approx(5.0, abs=1.0)
    assert answer["rotation_angle_deg"] == pytest.approx(5.0, abs=1.0)


def test_a_plane_slides_and_is_told_so(tmp_path, rng):
    for name in ("target", "source"):
        write_cloud(
            tmp_path / f"{name}.ply", np.hstack((rng.uniform(-1, 1, (COUNT, 2)), np.zeros((COUNT, 1)))) + [0, 0, 1]
        )
    answer = json.loads(run(tmp_path / "target.ply", tmp_path / "source.ply", "--json").stdout)
    assert not answer["trustworthy"]
    assert "not held by the points" in answer["status"]
    weakest = answer["weakest_direction"]
    assert weakest["share_of_mean_information"] < 1e-3
    assert "not held by the points" in run(tmp_path / "target.ply", tmp_path / "source.ply").stdout
    along = weakest["axis"][2]
    assert abs(along) == pytest.approx(1.0 if weakest["motion"] == "rotation" else 0.0, abs=1e-3)


# Bad input.


def test_bad_input_is_told_in_one_sentence(files, tmp_path):
    target, source = files
    (tmp_path / "cut.ply").write_bytes((tmp_path / "target.ply").read_bytes()[:500])
    (tmp_path / "start.txt").write_text("1 2 3\n")
    (tmp_path / "one.csv").write_text("x,y,z\n1,2,3\n")
    (tmp_path / "flat.csv").write_text("1,2\n3,4\n5,6\n")
    for arguments, words in (
        ((tmp_path / "none.ply", source), "none.ply does not exist"),
        ((target, tmp_path), "is a folder"),
        ((target, tmp_path / "cut.ply"), "the file is cut short"),
        ((target, source, "--out", tmp_path / "nowhere" / "a.ply"), "is not a folder; create it first"),
        ((target, source, "--out", tmp_path / "a.gif"), "suffix '.gif'; writable are"),
        ((target, source, "--start", tmp_path / "start.txt"), "start.txt has poses of shape (1, 1, 3)"),
        ((target, source, "--points", 1), "points is 1"),
        ((target, source, "--preset", "fast", "--loss", "F"), "loss is F and preset is fast"),
        ((target, tmp_path / "one.csv"), "the source has 1 points; in 3D at least 4"),
        ((target, tmp_path / "flat.csv"), "one cloud is 2D and the other 3D"),
    ):
        assert words in refused(*arguments)
    assert not (tmp_path / "a.gif").exists()


def test_a_start_out_of_the_plane(tmp_path, motion):
    (tmp_path / "flat.csv").write_text("1,2\n3,4\n5,7\n6,1\n")
    np.savetxt(tmp_path / "start.txt", motion)
    told = refused(tmp_path / "flat.csv", tmp_path / "flat.csv", "--start", tmp_path / "start.txt")
    assert "leaves the plane" in told


def test_bad_input_of_the_whole_program(tmp_path):
    command = [sys.executable, "-m", "bbr_layer", "register", str(tmp_path / "a.ply"), str(tmp_path / "b.ply")]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    assert "does not exist" in ended.stderr
    assert "Traceback" not in ended.stderr + ended.stdout


def test_the_share_of_buddies_is_that_of_the_smaller_cloud(rng):
    points = rng.random((60, 3))
    for clouds in ((points, points[:30]), (points[:30], points)):
        verdict = register_clouds(*(Cloud(some) for some in clouds), start=np.eye(4)).verdict
        assert verdict.buddies > 20 and verdict.buddy_share == verdict.buddies / 30


def test_the_moved_source_is_written_with_its_normals_turned(tmp_path, rng):
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    normals = rng.normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    write_moved(tmp_path / "moved.ply", Cloud(rng.random((20, 3)), normals), turn)
    wanted = Rotation.from_matrix(turn[:3, :3]).apply(normals)
    np.testing.assert_allclose(read_cloud(tmp_path / "moved.ply").normals, wanted, atol=1e-12)


def test_soft_stages_alone_see_as_few_points_as_asked():
    assert _stages("softBD", "default", 50)[0].points == 50
    assert _stages("F", "default", 50)[0].points is None
    assert _stages("default", "fast", 50)[0].points == _stages("default", "default", 50)[0].points == 50


def test_normals_that_leave_the_plane_are_left_out_of_flat_clouds(rng):
    points, up = np.c_[rng.random((9, 2)), np.zeros(9)], np.tile([0.0, 0.0, 1.0], (9, 1))
    assert all(cloud.normals is None for cloud in common_dimension(*[Cloud(points, up)] * 2))
    along = common_dimension(*[Cloud(points, up[:, [2, 1, 0]])] * 2)
    assert all(cloud.normals.tolist() == [[1.0, 0.0]] * 9 for cloud in along)


def test_deviations_of_turns_are_in_degrees():
    turn, slide = (Direction(turning, np.array([0.0, 0, 1]), 0.1, 1.0, False) for turning in (True, False))
    assert _plain(turn)["deviation"] == pytest.approx(np.rad2deg(0.1)) and _plain(slide)["deviation"] == 0.1


def test_people_read_of_the_weakest_direction(rng):
    cloud = Cloud(rng.random((60, 3)) * [3, 2, 1])
    found, told = register_clouds(cloud, Cloud(cloud.points + 0.01), start=np.eye(4)), io.StringIO()
    show(Console(file=told, width=200), found, described(found, cloud, cloud), None)
    assert found.registration.directions[0].words in told.getvalue()
