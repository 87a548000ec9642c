"""The functional twin of the layer, for tensors and numpy arrays alike."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from bbr_layer.arrays import arrays, from_array, tensors
from bbr_layer.clouds import Cloud
from bbr_layer.geometry import RigidMotion
from bbr_layer.layer import BBRLayer
from bbr_layer.pair import CloudPair
from bbr_layer.registration import Registration

Array = torch.Tensor | np.ndarray
Points = Array | Cloud
# What can be said of a pair beside the two clouds.
GIVEN = {*CloudPair._fields, "start"} - {"P", "Q", "spacing"}


def register(P: Points, Q: Points, *, layer: BBRLayer | None = None, **given: Array | RigidMotion) -> Registration:
    """Find the motion that carries Q onto P; numpy arrays are answered in numpy, and may be of any type of number.

    Where P or Q is a tensor the answer is in tensors, differentiable, and arrays become tensors of its kind.

    Parameters
    ----------
    P, Q: ``(*batch, n, d)`` target and ``(*batch, m, d)`` source; or each a ``Cloud`` as ``read_cloud`` gives it, with
        the normals it has.
    layer: default ``BBRLayer()``; settings are the layer's, ``layer=BBRLayer.robust()``.
    given: normals, features, weights, masks and start, as ``BBRLayer.forward`` names them; the start may be a matrix
        ``(*batch, d + 1, d + 1)``.

    Raises
    ------
    TypeError: another argument.
    ValueError: one sentence on what is wrong with which argument.

    >>> cloud = np.random.default_rng(0).random((50, 2))
    >>> register(cloud, cloud).target_from_source.matrix.round(3) + 0.0
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    tensor = next((x for x in (P, Q) if isinstance(x, torch.Tensor)), None)
    for side, cloud in (("P", P), ("Q", Q)):
        if isinstance(cloud, Cloud) and cloud.normals is not None:
            given.setdefault(f"{side}_normals", cloud.normals)
    P, Q = (x.points if isinstance(x, Cloud) else x for x in (P, Q))
    unknown = sorted(given.keys() - GIVEN)
    if unknown:
        known = ", ".join(sorted(GIVEN))
        raise TypeError(
            f"register has no argument {unknown[0]}; there are layer, {known}, and the layer has the settings: "
            "try layer=BBRLayer.robust()"
        )
    chosen = BBRLayer() if layer is None else layer
    start = given.pop("start", None)
    if start is not None:
        given["start"] = tensors(start) if isinstance(start, RigidMotion) else RigidMotion.from_matrix(_matrix(start))
    if tensor is not None:
        return chosen(**{name: _beside(tensor, name, x) for name, x in {"P": P, "Q": Q, **given}.items()})
    answer: Registration = arrays(chosen(**_of_one_type({"P": P, "Q": Q, **given})))
    return answer


def _beside(tensor: torch.Tensor, name: str, given: Array | RigidMotion | None) -> torch.Tensor | RigidMotion | None:
    """An array as a tensor beside one, masks as they are."""
    if given is None or isinstance(given, torch.Tensor | RigidMotion):
        return given
    array = _numbers(name, given)
    return from_array(array).to(tensor.device, torch.bool if array.dtype == bool else tensor.dtype)


def _matrix(start: Array) -> torch.Tensor:
    matrix = start if isinstance(start, torch.Tensor) else from_array(_numbers("start", start))
    if matrix.ndim < 2 or matrix.shape[-1] not in (3, 4) or matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"start has shape {tuple(matrix.shape)}; give a RigidMotion, or a 4 x 4 matrix (in 2D 3 x 3)")
    return matrix.double()


def _of_one_type(given: Mapping[str, Array | RigidMotion]) -> dict[str, torch.Tensor | RigidMotion]:
    """Arrays as tensors, all numbers of the type that holds each of them, float32 at least; the rest as it is."""
    found, others = {}, {}
    for name, x in given.items():
        if isinstance(x, torch.Tensor | RigidMotion):
            others[name] = x
        else:
            found[name] = _numbers(name, x)
    wanted = np.result_type(np.float32, *(x.dtype for x in found.values()))
    wanted = min(wanted, np.dtype(np.float64))  # there are no wider tensors
    return others | {name: from_array(x if x.dtype == bool else x.astype(wanted)) for name, x in found.items()}


def _numbers(name: str, given: Array) -> np.ndarray:
    if isinstance(given, str | Path):
        raise ValueError(f"{name} is a file's name, {str(given)!r}: give what read_cloud reads from it")
    try:
        array = np.asarray(given)
    except ValueError as error:
        raise ValueError(f"{name} is no array of numbers, its rows are not of one length: {error}") from None
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} is an array of {array.dtype}; it must hold numbers: try {name}.astype(float)")
    return array
