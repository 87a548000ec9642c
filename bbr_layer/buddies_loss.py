"""A best-buddies loss between two clouds as they lie: what a network is trained with in place of a Chamfer distance."""

import warnings

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bbr_layer.door import batch_shape, checked_pair, own_precision
from bbr_layer.geometry import RigidMotion
from bbr_layer.inner.pose_gradient import PairKernel
from bbr_layer.loss_base import Loss
from bbr_layer.losses import BuddyFilter, SoftBBS, SoftBD
from bbr_layer.matches import matched, pair_weights
from bbr_layer.named_stages import named_loss
from bbr_layer.pair import CloudPair
from bbr_layer.preparation import prepared
from bbr_layer.transforms import is_transformed

# Temperatures in point spacings: where the layer ends (soft buddies), and between where its F begins and ends.
SOFT, HARD = 1.0, 0.1


class BestBuddiesLoss(nn.Module):
    """One of the paper's losses between P and Q, neither of them moved; nothing of size n x m is kept for the gradient.

    A Chamfer distance pulls every point to its nearest one; here only best buddies pull, so that what the other cloud
    does not have stays where it is. Soft buddies reach as far as about 20 temperatures: where clouds begin farther
    apart than that many spacings softBBS and softBD are 0, as little as they can be, and have no gradient, which is
    warned of. Then begin with a higher temperature, or with F, which pulls from any distance.

    Parameters
    ----------
    loss: ``"softBD"`` (default, Eq. 6), ``"softBBS"`` (5), ``"N"`` (6 on the distance 7), ``"F"`` (8), or a loss.
    temperature: alpha in point spacings, positive. None: 1, for F 0.1.

    Raises
    ------
    ValueError: settings that cannot work, where they are given.

    >>> P = torch.rand(100, 3, generator=torch.Generator().manual_seed(0), requires_grad=True)
    >>> loss = BestBuddiesLoss()(P, P.detach() + 0.01)
    >>> loss.backward()
    >>> loss.shape, bool(P.grad.abs().max() > 0)
    (torch.Size([]), True)
    """

    def __init__(self, loss: str | Loss = "softBD", temperature: float | None = None):
        super().__init__()
        self.loss = named_loss(loss) if isinstance(loss, str) else loss
        if not isinstance(self.loss, Loss):
            raise ValueError(f"loss is {loss!r}; it must be one of the four losses: try 'softBD'")
        usual = HARD if isinstance(self.loss, BuddyFilter) else SOFT
        self.temperature = usual if temperature is None else temperature
        if not self.temperature > 0:
            raise ValueError(f"temperature is {temperature}; it must be positive, in point spacings: try {usual}")

    def forward(
        self,
        P: Tensor,
        Q: Tensor,
        *,
        P_normals: Tensor | None = None,
        Q_normals: Tensor | None = None,
        P_features: Tensor | None = None,
        Q_features: Tensor | None = None,
        P_weights: Tensor | None = None,
        Q_weights: Tensor | None = None,
        P_mask: Tensor | None = None,
        Q_mask: Tensor | None = None,
    ) -> Float[Tensor, "*batch"]:
        """The loss of each pair, ``(*batch,)``: a length in the data's unit; for softBBS minus the number of buddies.

        Differentiable once in all that is given but the masks; the point spacing and the buddies of F are held.

        Parameters
        ----------
        P, Q: ``(*batch, n, d)`` and ``(*batch, m, d)``, d = 2 or 3, any unit.
        P_normals, Q_normals, P_features, Q_features, P_weights, Q_weights, P_mask, Q_mask: as in ``BBRLayer``.

        Raises
        ------
        ValueError: one sentence on what is wrong with which argument.
        RuntimeError: called under ``torch.func``.
        """
        given = CloudPair(P, Q, P_normals, Q_normals, P_features, Q_features, P_weights, Q_weights, P_mask, Q_mask)
        if torch.compiler.is_compiling():
            return torch.compiler.disable(self._of)(given)
        return self._of(given)

    def _of(self, given: CloudPair) -> Tensor:
        if is_transformed(given):
            raise RuntimeError(
                "BestBuddiesLoss does not go through torch.func: use torch.autograd.grad, and batches for vmap"
            )
        with own_precision(given) as widened:
            flat = checked_pair(widened)
            frame, pair = prepared(flat, self.loss.needs_normals, False)
            temperature = self.temperature * self.loss.temperature_unit(pair).double().detach()
            rounding = self.loss.smoothing * pair.known_spacing().double().detach()
            still = frame.enter(RigidMotion.identity(pair.P.shape[-1], pair.P.shape[:1], device=pair.P.device))
            found = PairKernel(self.loss.kernel(pair), pair, rounding).slope(still, temperature).loss
            if isinstance(self.loss, SoftBBS | SoftBD):
                _warn_out_of_reach(found.detach(), pair, still)
        return found.to(flat.P.dtype).reshape(batch_shape(given.P))

    def extra_repr(self) -> str:
        """The temperature, beside the loss that a module prints by itself."""
        return f"temperature={self.temperature}"


@torch.no_grad()
def _warn_out_of_reach(loss: Tensor, pair: CloudPair, still: RigidMotion) -> None:
    """Where a soft loss is 0 though best buddies lie apart."""
    if not (loss == 0).any():
        return
    found = matched(pair, still)
    apart = torch.linalg.vector_norm(found.offsets, dim=-1) * pair_weights(pair, found) * found.mutual
    if ((loss == 0) & (apart.sum(-1) > 0)).any():
        warnings.warn(
            "no soft buddies are within reach: the loss is 0 and has no gradient; give a higher temperature, or begin "
            "with BestBuddiesLoss('F')",
            stacklevel=4,
        )
