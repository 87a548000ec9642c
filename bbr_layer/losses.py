"""The paper's four losses, one small class each; all are minimised and answer one number per pair of clouds.

A loss is called with a ``CloudPair`` whose source has been moved, and a temperature ``(batch,)``.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from bbr_layer.buddies import OUTLIER_CONSTANT
from bbr_layer.distances import flattened, matched_plane_normals, smooth_root, symmetric_point_to_plane
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.matched import MatchedKernel
from bbr_layer.kernels.scene import Kernel, SoftTerms
from bbr_layer.kernels.squares import MatchedSquares, Squares, gathered
from bbr_layer.loss_base import Loss, Objective, SoftLoss, weighted_mean
from bbr_layer.pair import CloudPair
from bbr_layer.searches import search_of


class SoftBBS(SoftLoss):
    """Eq. 5: minus the sum of soft buddies. The widest basin and the least accurate of the four.

    Parameters
    ----------
    smoothing: in point spacings, see ``Loss``. Default 0.
    outlier: the epsilon of Eq. 4. Default 1e-10.
    match: what buddies are found by: ``"points"``, ``"both"`` (coordinates and features side by side), or
        ``"auto"`` (default): both when features are given.
    feature_weight: inner length units per unit of feature distance. Default 1: a feature distance of 1 counts as
        much as one cloud radius (in the layer's scaled frame; one data unit in the paper's).

    Raises
    ------
    ValueError: ``match="features"``: the sum would not depend on the pose; negative or unknown settings.
    """

    def __init__(
        self,
        *,
        smoothing: float = 0.0,
        outlier: float = OUTLIER_CONSTANT,
        match: str = "auto",
        feature_weight: float = 1.0,
    ):
        super().__init__(smoothing=smoothing, outlier=outlier, match=match, feature_weight=feature_weight)
        if match == "features":
            raise ValueError("match='features' leaves softBBS without a pose to find: use match='both', or SoftBD")

    def terms(self, match: str) -> SoftTerms:
        return SoftTerms(mean=False, outlier=self.outlier, match=match, feature_weight=self.feature_weight)

    def forward(self, pair: CloudPair, temperature: Float[Tensor, "batch"]) -> Float[Tensor, "batch"]:
        return -self.buddies(pair, self.distances(pair), temperature).sum((-1, -2), dtype=torch.float64)


class SoftBD(SoftLoss):
    """Eq. 6: the mean distance between soft buddies, weighted by how much they are buddies.

    Parameters as for ``SoftBBS``; with ``match="features"`` buddies are found by features alone and the loss is
    their distance in space.
    """

    def terms(self, match: str) -> SoftTerms:
        return SoftTerms(mean=True, outlier=self.outlier, match=match, feature_weight=self.feature_weight)

    def forward(self, pair: CloudPair, temperature: Float[Tensor, "batch"]) -> Float[Tensor, "batch"]:
        distances = self.distances(pair)
        return weighted_mean(distances, self.buddies(pair, distances, temperature))


class SoftBDNormals(SoftLoss):
    """N: Eq. 6 on the symmetric point-to-plane distance of Eq. 7, for the buddies and for the mean.

    Parameters
    ----------
    smoothing, outlier: as for ``SoftBBS``.
    align_signs: turn normals of opposite sides before adding them. Default True; the printed equation does not.
    clip: squared distances are clipped at this many standard deviations above their mean, as the authors' code
        does (``ValueError`` unless positive); None (default, the printed equation) clips nothing.
    """

    needs_normals = True

    def __init__(
        self,
        *,
        smoothing: float = 0.0,
        outlier: float = OUTLIER_CONSTANT,
        align_signs: bool = True,
        clip: float | None = None,
    ):
        super().__init__(smoothing=smoothing, outlier=outlier, match="points")
        if clip is not None and not clip > 0:
            raise ValueError(f"clip is {clip}; it must be positive, in standard deviations, or None: try 3.0")
        self.align_signs, self.clip = align_signs, clip

    def extra_repr(self) -> str:
        return f"{super().extra_repr()}, align_signs={self.align_signs}, clip={self.clip}".replace(
            ", match='points', feature_weight=1.0", ""
        )

    def terms(self, match: str) -> SoftTerms:
        return SoftTerms(True, True, self.align_signs, outlier=self.outlier, clip=self.clip)

    def squares(self, pair: CloudPair) -> Squares:
        if self.clip is not None:
            raise ValueError(f"clip is {self.clip}; GaussNewton cannot clip distances: clip=None, or inner=Adam()")
        pair.both_normals()
        return super().squares(pair)

    def distances(self, pair: CloudPair) -> Float[Tensor, "batch n m"]:
        distances = symmetric_point_to_plane(pair, self.rounding(pair), self.align_signs)
        if self.clip is None:
            return distances
        return torch.minimum(distances, _clipping_distance(distances.detach(), pair.pair_mask(), self.clip))

    def forward(self, pair: CloudPair, temperature: Float[Tensor, "batch"]) -> Float[Tensor, "batch"]:
        distances = self.distances(pair)
        return weighted_mean(distances, self.buddies(pair, distances, temperature))


class BuddyFilter(Loss):
    """F, Eq. 8 with its sign and norm mended: the mean of Eq. 7 over hard best buddies, found by Eq. 2 at each call.

    Normals of a pair are turned to one side first. The temperature is the length below which the absolute value is
    rounded off, ``sqrt(r^2 + temperature^2)``; at 0 it is the paper's, whose own curvature is 0 almost everywhere.
    No buddies: the loss is 0 and so is its gradient.

    Parameters
    ----------
    smoothing: not used: F is rounded off by its temperature.
    reach: a distance d counts as ``d / (1 + d / (reach * temperature))``, so that pairs of different surfaces, which
        lie far apart, hardly pull. Default infinite, the printed equation; the layer's default has 50,
        benchmarks/reach.md.
    alike: in the equations of ``GaussNewton`` a pair counts as its points are alike (``kernels/likeness.py``). The loss
        stays as it is: ``Adam`` is refused. Default False; the layer's default ends with it, benchmarks/likeness.md.

    Raises
    ------
    ValueError: a reach that is not positive.
    """

    needs_normals = True

    def __init__(self, smoothing: float = 0.0, *, reach: float = math.inf, alike: bool = False):
        super().__init__(smoothing)
        if not reach > 0:
            raise ValueError(f"reach is {reach}; it is a length in temperatures and positive: try 50, or math.inf")
        self.reach, self.alike = reach, alike

    def objective(self, pair: CloudPair) -> Objective:
        search = search_of(pair)

        def evaluate(motion: RigidMotion, temperature: Tensor) -> Tensor:
            return self._matched(pair.moved_by(motion), temperature, *search(motion))

        return evaluate

    def kernel(self, pair: CloudPair) -> Kernel:
        pair.both_normals()
        return MatchedKernel(search_of(pair), self.reach)

    def squares(self, pair: CloudPair) -> Squares:
        pair.both_normals()
        return MatchedSquares(search_of(pair), self.reach, self.alike)

    def forward(self, pair: CloudPair, temperature: Float[Tensor, "batch"]) -> Float[Tensor, "batch"]:
        search = search_of(pair)
        still = RigidMotion.identity(pair.Q.shape[-1], pair.Q.shape[:1], device=pair.Q.device)
        return self._matched(pair, temperature, *search(still))

    def extra_repr(self) -> str:
        told = [f"smoothing={self.smoothing}"] if self.smoothing else []
        told += [f"reach={self.reach:g}"] if math.isfinite(self.reach) else []
        return ", ".join(told + ["alike=True"] * self.alike)

    def _matched(self, pair: CloudPair, temperature: Tensor, index: Tensor, mutual: Tensor) -> Tensor:
        P_normals, Q_normals = pair.both_normals()
        normals = matched_plane_normals(gathered(P_normals, index), Q_normals)
        residual = ((pair.Q - gathered(pair.P, index)) * normals).sum(-1)
        weights = mutual.to(residual.dtype)
        if pair.P_weights is not None:
            weights = weights * pair.P_weights.gather(1, index)
        if pair.Q_weights is not None:
            weights = weights * pair.Q_weights
        rounding = temperature.to(residual.dtype)[:, None]
        distances = flattened(smooth_root(residual.square(), rounding), rounding, self.reach)
        return weighted_mean(distances[:, None], weights[:, None])


def _clipping_distance(distances: Tensor, mask: Tensor | None, deviations: float) -> Tensor:
    """Root of (mean + deviations x standard deviation) of the squared distances, ``(batch, 1, 1)``."""
    squared = distances.square() if mask is None else torch.where(mask, distances.square(), torch.nan)
    mean = squared.nanmean((-1, -2), keepdim=True)
    spread = (squared - mean).square().nanmean((-1, -2), keepdim=True).sqrt()
    return (mean + deviations * spread).sqrt().nan_to_num(0.0)
