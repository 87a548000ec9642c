"""Two processes train one model with the layer inside: their gradient is the mean of what each alone would have."""

import torch
from torch import Tensor, distributed, multiprocessing, nn
from torch.nn.parallel import DistributedDataParallel

from bbr_layer import Adam, Annealed, BBRLayer

RANKS = 2


class Weighing(nn.Module):
    """A network that says which points to trust, judged by where the layer then puts them."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.trust = nn.Linear(3, 1, dtype=torch.float64)
        self.layer = BBRLayer("softBD", inner=Adam(5, 0.05), temperature=Annealed(1.0, 0.5))

    def forward(self, P: Tensor, Q: Tensor) -> Tensor:
        result = self.layer(P, Q, Q_weights=self.trust(Q)[..., 0].sigmoid())
        return result.target_from_source.matrix.square().sum()


def pair_of(rank: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(rank)
    P = torch.rand(1, 20, 3, generator=generator, dtype=torch.float64)
    return P, P[:, :15] + 0.05 * torch.rand(1, 15, 3, generator=generator, dtype=torch.float64)


def gradient(model: nn.Module, rank: int) -> Tensor:
    model(*pair_of(rank)).backward()
    return torch.cat([parameter.grad.flatten() for parameter in model.parameters()])


def work(rank: int, folder: str) -> None:
    """One process: the gradient that it ends with, into a file."""
    distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=RANKS)
    torch.save(gradient(DistributedDataParallel(Weighing()), rank), f"{folder}/{rank}.pt")
    distributed.destroy_process_group()


def test_processes_share_the_mean_gradient(tmp_path):
    alone = torch.stack([gradient(Weighing(), rank) for rank in range(RANKS)])
    multiprocessing.spawn(work, (str(tmp_path),), nprocs=RANKS)
    shared = [torch.load(tmp_path / f"{rank}.pt") for rank in range(RANKS)]
    assert alone[0].abs().sum() > 0 and not torch.allclose(alone[0], alone[1])
    for found in shared:
        torch.testing.assert_close(found, alone.mean(0), rtol=1e-10, atol=1e-14)
