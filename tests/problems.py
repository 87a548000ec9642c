"""Small registration problems with everything a layer can be given, and a known answer."""

import torch

from bbr_layer import CloudPair, RigidMotion

N, M = 7, 9


def motion(d: int, angle: float = 0.2, shift: float = 0.1) -> RigidMotion:
    """A known motion: ``angle`` radians about a slanted axis, ``shift`` along every axis."""
    axis = torch.ones(1 if d == 2 else 3, dtype=torch.float64)
    return RigidMotion.from_rotvec(axis / axis.norm() * angle, torch.full((d,), shift, dtype=torch.float64))


def unit(vectors: torch.Tensor) -> torch.Tensor:
    """Vectors of length 1."""
    return vectors / vectors.norm(dim=-1, keepdim=True)


def noisy_pair(d: int, batch: int = 1, n: int = N, m: int = M) -> dict[str, torch.Tensor]:
    """Two noisy views of one cloud with normals, features and weights, float64, ``(batch, n, d)`` and so on."""
    size = max(n, m)
    cloud = torch.randn(batch, size, d, dtype=torch.float64)
    normals = unit(torch.randn(batch, size, d, dtype=torch.float64))
    features = torch.randn(batch, size, 4, dtype=torch.float64)
    back = motion(d).inverse()
    noise = 0.05 * torch.randn(batch, m, d, dtype=torch.float64)
    return {
        "P": cloud[:, :n].clone(),
        "Q": back(cloud[:, :m]) + noise,
        "P_normals": normals[:, :n].clone(),
        "Q_normals": unit(back.rotate(normals[:, :m]) + 0.1 * noise),
        "P_features": features[:, :n].clone(),
        "Q_features": features[:, :m] + noise.mean(-1, keepdim=True),
        "P_weights": 0.5 + torch.rand(batch, n, dtype=torch.float64),
        "Q_weights": 0.5 + torch.rand(batch, m, dtype=torch.float64),
    }


def as_pair(given: dict[str, torch.Tensor], *names: str) -> CloudPair:
    """P, Q and the companions named (``"normals"``, ...), with a spacing of 0.5."""
    chosen = {k: v for k, v in given.items() if k in ("P", "Q") or k.split("_")[1] in names}
    return CloudPair(**chosen, spacing=torch.full((given["P"].shape[0],), 0.5, dtype=torch.float64))


def bumpy(n: int, d: int) -> torch.Tensor:
    """A closed curve or surface with no symmetry, float64."""
    directions = torch.randn(n, d, dtype=torch.float64)
    directions = directions / directions.norm(dim=1, keepdim=True)
    bumps = 1 + 0.3 * torch.sin(2 * directions[:, :1] + 1) * torch.cos(3 * directions[:, 1:2])
    return directions * bumps * torch.tensor([1.0, 0.7, 0.5][:d], dtype=torch.float64)
