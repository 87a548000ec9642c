"""Equations 2 to 8 of the paper as loops that nobody can misread. Slow, unbatched, for the tests alone."""

import math

import torch


def distance(p, q):
    """Euclidean distance of two points."""
    return torch.linalg.vector_norm(p - q)


def distances(P, Q):
    """D[i, j], from P[i] to Q[j]."""
    return torch.stack([torch.stack([distance(p, q) for q in Q]) for p in P])


def point_to_plane(p, q, p_normal, q_normal, align_signs):
    """Eq. 7, with the sign of the target's normal turned to the source's if asked."""
    if align_signs and torch.dot(p_normal, q_normal) < 0:
        p_normal = -p_normal
    return torch.abs(torch.dot(q - p, q_normal + p_normal))


def point_to_plane_distances(P, Q, P_normals, Q_normals, align_signs=True):
    """D^n[i, j] of Eq. 7."""
    return torch.stack(
        [
            torch.stack([point_to_plane(p, q, a, b, align_signs) for q, b in zip(Q, Q_normals, strict=True)])
            for p, a in zip(P, P_normals, strict=True)
        ]
    )


def hard_buddies(D):
    """Eq. 2."""
    n, m = D.shape
    B = torch.zeros(n, m, dtype=D.dtype)
    for i in range(n):
        for j in range(m):
            nearest_to_j = min(range(n), key=lambda k: D[k, j].item())
            nearest_to_i = min(range(m), key=lambda k: D[i, k].item())
            B[i, j] = float(nearest_to_j == i and nearest_to_i == j)
    return B


def bbs(D):
    """Eq. 3: minus the number of best buddies."""
    return -sum(hard_buddies(D)[i, j] for i in range(D.shape[0]) for j in range(D.shape[1]))


def soft_buddies(D, alpha, eps):
    """Eq. 4."""
    n, m = D.shape
    rows = []
    for i in range(n):
        row = []
        for j in range(m):
            over_row = eps + sum(torch.exp(-D[i, k] / alpha) for k in range(m))
            over_column = eps + sum(torch.exp(-D[k, j] / alpha) for k in range(n))
            row.append(torch.exp(-D[i, j] / alpha) / over_row * torch.exp(-D[i, j] / alpha) / over_column)
        rows.append(torch.stack(row))
    return torch.stack(rows)


def soft_bbs(D, alpha, eps, weights=None):
    """Eq. 5, each pair counted with its weight."""
    B = soft_buddies(D, alpha, eps)
    return -sum(B[i, j] * _weight(weights, i, j) for i in range(D.shape[0]) for j in range(D.shape[1]))


def soft_bd(D, alpha, eps, weights=None, matching=None):
    """Eq. 6; buddies found by ``matching`` where that is another distance."""
    B = soft_buddies(D if matching is None else matching, alpha, eps)
    pairs = [(i, j) for i in range(D.shape[0]) for j in range(D.shape[1])]
    top = sum(B[i, j] * _weight(weights, i, j) * D[i, j] for i, j in pairs)
    return top / sum(B[i, j] * _weight(weights, i, j) for i, j in pairs)


def buddy_filter(D, D_normal, weights=None):
    """Eq. 8 with the plus sign and the mean of the authors' code."""
    B = hard_buddies(D)
    pairs = [(i, j) for i in range(D.shape[0]) for j in range(D.shape[1])]
    top = sum(B[i, j] * _weight(weights, i, j) * D_normal[i, j] for i, j in pairs)
    return top / sum(B[i, j] * _weight(weights, i, j) for i, j in pairs)


def flattened(D, width):
    """A distance d counts as d / (1 + d / width)."""
    flat = torch.empty_like(D)
    for i in range(D.shape[0]):
        for j in range(D.shape[1]):
            flat[i, j] = D[i, j] / (1 + D[i, j] / width)
    return flat


def likeness(offset, p_normal, q_normal, spacing):
    """How much a pair of points counts: half of it at one spacing, half of it at a cosine of 0.9 of the normals."""
    apart = sum(x * x for x in offset) / spacing**2
    cosine = abs(sum(a * b for a, b in zip(p_normal, q_normal, strict=True)))
    return 1 / (1 + apart) * 0.1 / (0.1 + (1 - cosine))


def normal_equations(residuals, counts):
    """sum of c J J^T and of c r J over residuals r_k, given as a function of six (in the plane three) pose numbers.

    A pair's residual is a number or a vector; J is its derivative at no motion.
    """
    k = residuals.tangent
    still = torch.zeros(k, dtype=torch.float64)
    matrix, slope = torch.zeros(k, k, dtype=torch.float64), torch.zeros(k, dtype=torch.float64)
    for index, count in counts.items():
        J = torch.func.jacrev(lambda x, index=index: residuals(x, *index))(still).reshape(-1, k)
        r = residuals(still, *index).reshape(-1)
        for row, value in zip(J, r, strict=True):
            matrix, slope = matrix + count * torch.outer(row, row), slope + count * value * row
    return matrix, slope


def euler_rotation(a, b, c):
    """Rz(c) Ry(b) Rx(a), entry by entry."""
    x = torch.tensor([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    y = torch.tensor([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    z = torch.tensor([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
    return z.double() @ y.double() @ x.double()


def _weight(weights, i, j):
    return 1.0 if weights is None else weights[0][i] * weights[1][j]
