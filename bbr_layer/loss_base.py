"""What the losses share: binding to a pair of clouds, rounding off at zero, weights, and soft matching."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bbr_layer.buddies import OUTLIER_CONSTANT, soft_buddies
from bbr_layer.distances import point_to_point, smooth_root, squared_distances
from bbr_layer.geometry import RigidMotion
from bbr_layer.kernels.scene import Kernel, SoftTerms
from bbr_layer.kernels.soft import SoftKernel
from bbr_layer.kernels.soft_squares import SoftSquares
from bbr_layer.kernels.squares import Squares
from bbr_layer.pair import CloudPair
from bbr_layer.spacing import point_spacing

Objective = Callable[[RigidMotion, Tensor], Tensor]


class Loss(nn.Module, ABC):
    """What the four losses share: rounding off at zero, weights, and binding to one pair of clouds.

    Parameters
    ----------
    smoothing: distances are rounded off below this multiple of the point spacing. 0 is the printed equation;
        the layer's default is 0.2 (measured: without it the unrolled gradient of noise-free pairs explodes).

    Raises
    ------
    ValueError: a negative smoothing, or at the call one without ``pair.spacing``.
    """

    needs_normals: ClassVar[bool] = False

    def __init__(self, smoothing: float = 0.0):
        super().__init__()
        if smoothing < 0:
            raise ValueError(f"smoothing is {smoothing}; it is a length in point spacings: try 0 or 0.2")
        self.smoothing = smoothing

    def objective(self, pair: CloudPair) -> Objective:
        """The loss as a function of the motion and the temperature, with ``pair.Q`` not yet moved."""
        return lambda motion, temperature: self(pair.moved_by(motion), temperature)

    @abstractmethod
    def kernel(self, pair: CloudPair) -> Kernel:
        """The loss in closed form, for a pair whose source is not yet moved."""

    @abstractmethod
    def squares(self, pair: CloudPair) -> Squares:
        """The loss as least squares over held buddies, for ``GaussNewton``; the source of ``pair`` is not yet moved."""

    def temperature_unit(self, pair: CloudPair) -> Tensor:
        """Spacing that temperatures are multiples of, ``(batch,)``."""
        return pair.known_spacing().to(pair.P.dtype)

    def sees_features(self, pair: CloudPair) -> bool:
        """Whether anything but coordinates, normals and weights of the pair changes the loss."""
        return False

    def rounding(self, pair: CloudPair) -> Tensor | float:
        """Length below which distances are rounded off, ``(batch, 1, 1)`` or 0."""
        return self.smoothing * pair.known_spacing().to(pair.P.dtype)[:, None, None] if self.smoothing else 0.0


class SoftLoss(Loss):
    """A loss over soft buddies found by coordinates, by features, or by both; settings as ``SoftBBS`` lists them."""

    def __init__(
        self,
        *,
        smoothing: float = 0.0,
        outlier: float = OUTLIER_CONSTANT,
        match: str = "auto",
        feature_weight: float = 1.0,
    ):
        super().__init__(smoothing)
        if match not in ("auto", "points", "features", "both"):
            raise ValueError(f"match is {match!r}; it must be 'auto', 'points', 'features' or 'both'")
        if feature_weight <= 0:
            raise ValueError(f"feature_weight is {feature_weight}; it must be positive: match='points' ignores them")
        if outlier < 0:
            raise ValueError(f"outlier is {outlier}; the epsilon of Eq. 4 must not be negative: try 1e-10")
        self.outlier, self.match, self.feature_weight = outlier, match, feature_weight

    def kernel(self, pair: CloudPair) -> Kernel:
        """Sweeps over all pairs of points, by the fastest backend there is."""
        match = self._matching(pair)
        if match != "points":
            pair.both_features()
        return SoftKernel(self.terms(match))

    def squares(self, pair: CloudPair) -> Squares:
        """All pairs, each counting as much as it is a buddy."""
        match = self._matching(pair)
        if match != "points":
            pair.both_features()
        return SoftSquares(self, self.terms(match))

    def distances(self, pair: CloudPair) -> Float[Tensor, "batch n m"]:
        """What the loss lowers, for every pair of points."""
        return point_to_point(pair, self.rounding(pair))

    @abstractmethod
    def terms(self, match: str) -> SoftTerms:
        """What the kernels need to know; ``match`` is settled."""

    def extra_repr(self) -> str:
        features = f", match={self.match!r}, feature_weight={self.feature_weight}"
        return f"smoothing={self.smoothing}, outlier={self.outlier}" + (features if self.match != "auto" else "")

    def temperature_unit(self, pair: CloudPair) -> Tensor:
        """Spacing of what is matched: coordinates, weighted features, or the two side by side, ``(batch,)``."""
        if self._matching(pair) == "points":
            return super().temperature_unit(pair)
        P, Q = self._embedded(pair.P, pair.P_features, pair), self._embedded(pair.Q, pair.Q_features, pair)
        spacing = (point_spacing(P, pair.P_mask) + point_spacing(Q, pair.Q_mask)) / 2
        return torch.where(spacing > 0, spacing, 1.0)

    def sees_features(self, pair: CloudPair) -> bool:
        """Where buddies are found by them."""
        return self._matching(pair) != "points"

    def _matching(self, pair: CloudPair) -> str:
        if self.match == "auto":
            return "points" if pair.P_features is None or pair.Q_features is None else "both"
        return self.match

    def _embedded(self, points: Tensor, features: Tensor | None, pair: CloudPair) -> Tensor:
        if features is None:
            raise ValueError(f"P_features or Q_features is missing; match={self.match!r} needs both, or match='points'")
        weighted = self.feature_weight * features
        return weighted if self._matching(pair) == "features" else torch.cat((points, weighted), dim=-1)

    def buddies(self, pair: CloudPair, distances: Tensor, temperature: Tensor) -> Tensor:
        """Eq. 4 on ``distances``, or on distances of the features; times the weights of the two points."""
        if self._matching(pair) != "points":
            P, Q = (
                self._embedded(pair.P, pair.P_features, pair),
                self._embedded(pair.Q, pair.Q_features, pair),
            )
            distances = smooth_root(squared_distances(P, Q), self.rounding(pair))
        buddies = soft_buddies(distances, temperature, self.outlier, pair.pair_mask())
        if pair.P_weights is not None:
            buddies = buddies * pair.P_weights[:, :, None]
        if pair.Q_weights is not None:
            buddies = buddies * pair.Q_weights[:, None, :]
        return buddies


def weighted_mean(values: Float[Tensor, "batch n m"], weights: Float[Tensor, "batch n m"]) -> Float[Tensor, "batch"]:
    """``sum(weights * values) / sum(weights)`` per item in float64; 0 with derivative 0 where the weights vanish."""
    total = weights.sum((-1, -2), dtype=torch.float64)
    present = total > 0
    mean = (weights * values).sum((-1, -2), dtype=torch.float64) / torch.where(present, total, 1.0)
    return torch.where(present, mean, 0.0)
