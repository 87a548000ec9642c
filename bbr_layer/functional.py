"""The functional twin of the layer, for tensors and numpy arrays alike."""

import numpy as np
import torch

from bbr_layer.arrays import arrays, tensors
from bbr_layer.geometry import RigidMotion
from bbr_layer.layer import BBRLayer
from bbr_layer.pair import CloudPair
from bbr_layer.registration import Registration

Array = torch.Tensor | np.ndarray
# What can be said of a pair beside the two clouds.
GIVEN = {*CloudPair._fields, "start"} - {"P", "Q", "spacing"}


def register(P: Array, Q: Array, *, layer: BBRLayer | None = None, **given: Array | RigidMotion) -> Registration:
    """Find the motion that carries Q onto P; numpy arrays are answered in numpy.

    Parameters
    ----------
    P, Q: ``(*batch, n, d)`` target and ``(*batch, m, d)`` source.
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
    if isinstance(P, torch.Tensor):
        return chosen(P, Q, **given)
    others = {name: _as_tensor(name, x) if isinstance(x, np.ndarray) else x for name, x in given.items()}
    result = chosen(_as_tensor("P", P), _as_tensor("Q", Q), **others)
    answer: Registration = arrays(result)
    return answer


def _matrix(start: Array) -> torch.Tensor:
    matrix = _as_tensor("start", start)
    if matrix.ndim < 2 or matrix.shape[-1] not in (3, 4) or matrix.shape[-1] != matrix.shape[-2]:
        raise ValueError(f"start has shape {tuple(matrix.shape)}; give a RigidMotion, or a 4 x 4 matrix (in 2D 3 x 3)")
    return matrix.double()


def _as_tensor(name: str, array: Array) -> torch.Tensor:
    if isinstance(array, np.ndarray) and array.dtype.kind not in "biufc":
        raise ValueError(f"{name} is an array of {array.dtype}; it must hold numbers: try {name}.astype(float)")
    return torch.as_tensor(array)
