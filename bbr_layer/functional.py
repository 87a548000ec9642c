"""The functional twin of the layer, for tensors and numpy arrays alike."""

import numpy as np
import torch

from bbr_layer.geometry import RigidMotion
from bbr_layer.layer import BBRLayer
from bbr_layer.registration import Registration

Array = torch.Tensor | np.ndarray


def register(P: Array, Q: Array, *, layer: BBRLayer | None = None, **given: Array | RigidMotion) -> Registration:
    """Find the motion that carries Q onto P; numpy arrays are answered in numpy.

    Parameters
    ----------
    P, Q: ``(*batch, n, d)`` target and ``(*batch, m, d)`` source.
    layer: default ``BBRLayer()``.
    given: normals, features, weights, masks and start, as ``BBRLayer.forward`` names them.

    Raises
    ------
    ValueError: one sentence on what is wrong with which argument.

    >>> cloud = np.random.default_rng(0).random((50, 2))
    >>> register(cloud, cloud).target_from_source.rotation.round(3) + 0.0
    array([[1., 0.],
           [0., 1.]])
    """
    chosen = BBRLayer() if layer is None else layer
    if isinstance(P, torch.Tensor):
        return chosen(P, Q, **given)
    tensors = {name: _as_tensor(name, x) if isinstance(x, np.ndarray) else x for name, x in given.items()}
    result = chosen(_as_tensor("P", P), _as_tensor("Q", Q), **tensors)
    motion = RigidMotion(*(x.detach().numpy() for x in result.target_from_source))
    return Registration(motion, *(x.detach().numpy() for x in result[1:]))


def _as_tensor(name: str, array: Array) -> torch.Tensor:
    if isinstance(array, np.ndarray) and array.dtype.kind not in "biufc":
        raise ValueError(f"{name} is an array of {array.dtype}; it must hold numbers: try {name}.astype(float)")
    return torch.as_tensor(array)
