"""The functional twin: arrays of any kind, clouds as they are read, a matrix to begin at, and motions of arrays."""

from pathlib import Path

import numpy as np
import pytest
import torch
from problems import bumpy, motion, noisy_pair

from bbr_layer import (
    Adam,
    BBRLayer,
    Cloud,
    RigidMotion,
    angular_error,
    estimate_normals,
    point_spacing,
    read_cloud,
    register,
    translation_error,
    write_cloud,
)


def test_register_refuses_arrays_that_hold_no_numbers():
    P = np.random.default_rng(0).random((20, 3))
    with pytest.raises(ValueError, match="Q is an array of <U.*; it must hold numbers"):
        register(P, P.astype(str))
    with pytest.raises(ValueError, match="P_weights is an array of object"):
        register(P, P, P_weights=np.full(20, None))


def test_register_answers_numpy_with_numpy():
    P = bumpy(120, 3).numpy()
    result = register(P, P + 0.01)
    assert isinstance(result.target_from_source.rotation, np.ndarray)
    np.testing.assert_allclose(result.target_from_source.translation, -0.01, atol=2e-4)
    assert all(isinstance(x, np.ndarray) for x in result[1:])
    assert result.words == "converged" and result.weak_directions == []


def test_register_takes_arrays_as_they_come(as_a_user):
    P, truth = bumpy(120, 3), motion(3, 0.3, 0.1)
    Q = truth.inverse()(P)
    P, Q = P.numpy(), Q.numpy()
    plain = register(P, Q).target_from_source.matrix
    read_only = np.frombuffer(P.tobytes()).reshape(-1, 3)
    for other in ((read_only, Q), (np.asfortranarray(P), Q), (P[::-1][::-1], Q), (P.tolist(), Q)):
        np.testing.assert_array_equal(register(*other).target_from_source.matrix, plain)
    single = register(P.astype(np.float32), Q.astype(np.float32))
    assert single.loss.dtype == np.float64 and 0 < np.abs(single.target_from_source.matrix - plain).max() < 1e-4
    as_tensors = BBRLayer()(torch.from_numpy(P).float(), torch.from_numpy(Q).float()).target_from_source.matrix
    np.testing.assert_array_equal(single.target_from_source.matrix, as_tensors.numpy())
    mixed = register(P.astype(np.float32), Q)
    np.testing.assert_array_equal(
        mixed.target_from_source.matrix, register(P.astype(np.float32).astype(float), Q).target_from_source.matrix
    )
    grid = (1000 * P).astype(int)
    np.testing.assert_allclose(register(grid, grid).target_from_source.matrix, np.eye(4), atol=1e-3)


def test_register_takes_clouds_and_the_normals_that_they_have():
    P = bumpy(120, 3)
    Q, normals = motion(3, 0.3, 0.1).inverse()(P).numpy(), estimate_normals(P, 20).numpy()
    P, turned = P.numpy(), motion(3, 0.3, 0.1).inverse().rotate(estimate_normals(P, 20)).numpy()
    told = {"P_normals": normals, "Q_normals": turned}

    def matrix(*clouds, **given):
        return register(*clouds, **given).target_from_source.matrix

    assert not np.array_equal(matrix(P, Q, **told), matrix(P, Q))
    np.testing.assert_array_equal(matrix(Cloud(P, normals), Cloud(Q, turned)), matrix(P, Q, **told))
    np.testing.assert_array_equal(matrix(Cloud(P), Cloud(Q)), matrix(P, Q))
    np.testing.assert_array_equal(matrix(Cloud(P, normals), Cloud(Q)), matrix(P, Q, P_normals=normals))
    own = matrix(Cloud(P, normals), Cloud(Q, turned), P_normals=turned)
    np.testing.assert_array_equal(own, matrix(P, Q, P_normals=turned, Q_normals=turned))


def test_measures_of_arrays_are_arrays():
    P, one, other = bumpy(120, 3), motion(3, 0.3, 0.1), motion(3, 0.5, 0.2)
    for function, given in (
        (estimate_normals, (P, 12)),
        (point_spacing, (P,)),
        (angular_error, (one.rotation, other.rotation)),
        (translation_error, (one.translation, other.translation)),
        (RigidMotion.from_rotvec, (one.rotvec, one.translation)),
    ):
        found = function(*(x.numpy() if isinstance(x, torch.Tensor) else x for x in given))
        expected = function(*given)
        for x, y in zip(*((z if isinstance(z, tuple) else (z,)) for z in (found, expected)), strict=True):
            assert isinstance(x, np.ndarray)
            np.testing.assert_allclose(x, y.numpy(), atol=1e-12)


def test_a_motion_of_arrays_does_all_that_one_of_tensors_does():
    P, tensors = bumpy(120, 3), motion(3, 0.4, 0.3)
    arrays = RigidMotion(*(x.numpy() for x in tensors))
    pairs = [
        (arrays(P.numpy()), tensors(P)),
        (arrays.rotate(P.numpy()), tensors.rotate(P)),
        (arrays.matrix, tensors.matrix),
        (arrays.rotvec, tensors.rotvec),
        (arrays.inverse().matrix, tensors.inverse().matrix),
        ((arrays @ arrays.inverse()).matrix, torch.eye(4, dtype=torch.float64)),
        (arrays.compose(inner=arrays).matrix, tensors.compose(tensors).matrix),
    ]
    for found, expected in pairs:
        assert isinstance(found, np.ndarray)
        np.testing.assert_allclose(found, expected.numpy(), atol=1e-12)
    many = RigidMotion(*(np.stack([x, x]) for x in arrays))
    np.testing.assert_allclose(many.between(0, 1).matrix, np.eye(4), atol=1e-12)
    assert arrays.dimension == 3


@pytest.mark.parametrize("d", [2, 3])
def test_register_begins_at_a_matrix_too(d):
    given, start = noisy_pair(d), motion(d, 0.2, 0.1)
    P, Q = given["P"][0], given["Q"][0]
    slow = BBRLayer("softBD", inner=Adam(1, 1e-12))
    for begin in (start, start.matrix, start.matrix.numpy()):
        found = register(P.numpy(), Q.numpy(), layer=slow, start=begin).target_from_source
        np.testing.assert_allclose(found.matrix, start.matrix.numpy(), atol=1e-9)
    begun_at_arrays = register(P.numpy(), Q.numpy(), layer=slow, start=RigidMotion(*(x.numpy() for x in start)))
    np.testing.assert_allclose(begun_at_arrays.target_from_source.matrix, start.matrix.numpy(), atol=1e-9)
    found = register(P, Q, layer=slow, start=start.matrix).target_from_source
    torch.testing.assert_close(found.matrix, start.matrix)


def test_register_says_what_it_has_no_argument_for(as_a_user):
    P = bumpy(8, 3).numpy()
    with pytest.raises(TypeError, match=r"^register has no argument starts; there are layer, P_features,.*BBRLayer"):
        register(P, P, starts=7)
    with pytest.raises(ValueError, match=r"^start has shape \(3,\); give a RigidMotion, or a 4 x 4 matrix"):
        register(P, P, start=np.zeros(3))
    with pytest.raises(ValueError, match="^start moves 2D points and the clouds are 3D"):
        register(P, P, start=np.eye(3))


def test_a_tensor_and_a_file_go_together(tmp_path):
    points = np.random.default_rng(0).random((60, 3))
    write_cloud(tmp_path / "cloud.ply", points)
    cloud = read_cloud(tmp_path / "cloud.ply")
    for pair in ((torch.from_numpy(points), cloud), (cloud, torch.from_numpy(points))):
        assert register(*pair).target_from_source.matrix.dtype == torch.float64


def test_wide_numbers_are_made_narrower_and_ragged_ones_refused(as_a_user):
    points = np.random.default_rng(0).random((40, 2)).astype(np.longdouble)
    assert register(points, points).target_from_source.rotation.dtype == np.float64
    with pytest.raises(ValueError, match="P is no array of numbers, its rows are not of one length"):
        register([[0.0, 1.0], [2.0]], points)


@pytest.mark.parametrize("tensor", ["P", "Q"])
def test_a_tensor_beside_an_array_is_answered_in_tensors(tensor):
    given = {"P": bumpy(60, 3).double(), "Q": bumpy(60, 3).double()}
    mask = np.arange(60) < 50
    mixed = {k: x.clone().requires_grad_() if k == tensor else x.numpy() for k, x in given.items()}
    found = register(**mixed, P_mask=mask, Q_weights=np.ones(60))
    plain = register(**given, P_mask=torch.from_numpy(mask), Q_weights=torch.ones(60).double())
    torch.testing.assert_close(found.target_from_source.matrix.detach(), plain.target_from_source.matrix)
    found.target_from_source.matrix.square().sum().backward()
    assert mixed[tensor].grad.isfinite().all()


@pytest.mark.parametrize("name", ["scan.ply", Path("scan.ply")])
def test_a_files_name_is_no_cloud(name, as_a_user):
    with pytest.raises(ValueError, match="^Q is a file's name, 'scan.ply': give what read_cloud reads from it$"):
        register(bumpy(20, 3).numpy(), name)
    with pytest.raises(ValueError, match="^Q is a file's name, 'scan.ply'"):
        register(bumpy(20, 3), name)
