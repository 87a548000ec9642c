"""The plane in space: compiled code knows space alone."""

import numpy as np

# The components of a turn and shift in space that are free, by the data's dimension; the turn comes first.
AXES = {2: [2, 3, 4], 3: [0, 1, 2, 3, 4, 5]}


def matrices_in_space(matrices: np.ndarray, last: float = 1.0) -> np.ndarray:
    """Matrices ``(batch, d, d)`` as ``(batch, 3, 3)``, a copy; those of the plane with ``last`` on the third axis.

    A rotation of the plane has 1 there; the derivative by one has 0.
    """
    d = matrices.shape[-1]
    whole = np.zeros((len(matrices), 3, 3))
    whole[:, 2, 2] = last
    whole[:, :d, :d] = matrices
    return whole
