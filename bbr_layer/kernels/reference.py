"""The sweeps in torch: any device, any dtype, every setting; the oracle of the compiled ones, and what serves without.

Rows are taken a block at a time, so that two clouds of 20 000 points fit in one GB.
"""

import torch
from torch import Tensor

from bbr_layer.buddies import log_normaliser
from bbr_layer.kernels.blocks import Block, blocks, clipping_distance
from bbr_layer.kernels.forward_mode import along
from bbr_layer.kernels.scene import Direction, Scene, SoftTerms, loss_of_sums
from bbr_layer.pair import CloudPair


def soft_gradient(terms: SoftTerms, scene: Scene) -> tuple[Tensor, Scene]:
    """Loss ``(batch,)`` and gradient in closed form."""
    return _gradient(terms, scene, clipping_distance(terms, scene))


def soft_directional(terms: SoftTerms, scene: Scene, direction: Direction) -> tuple[Scene, Scene]:
    """The gradient and its derivative along ``direction``: the same sweeps in forward mode."""
    limit = clipping_distance(terms, scene)
    return along(lambda moved: _gradient(terms, moved, limit)[1], scene, direction)


def _gradient(terms: SoftTerms, scene: Scene, limit: Tensor | None) -> tuple[Tensor, Scene]:
    row_logs, column_logs = _normalisers(terms, scene, limit)
    weights = [_weights(scene.pair, side) for side in ("P", "Q")]
    row_sums, column_sums = _buddy_sums(terms, scene, limit, (row_logs, column_logs))
    S, M = ((weights[0] * x).sum(-1, dtype=torch.float64) for x in row_sums)
    loss, by_S, by_M = loss_of_sums(terms, S, M)
    by_sums = [x.to(scene.pair.P.dtype)[:, None] for x in (by_S, by_M)]
    # What a row or a column as a whole adds to the loss, per unit of its weight.
    row_shares, column_shares = (by_sums[0] * s + by_sums[1] * m for s, m in (row_sums, column_sums))
    collected = _Collected(terms, scene)
    for block, rows in blocks(terms, scene, limit):
        r, c = torch.exp(block.logits - row_logs[:, rows, None]), torch.exp(block.logits - column_logs[:, None])
        mask = block.pair.pair_mask()
        if mask is not None:
            r, c = torch.where(mask, r, 0.0), torch.where(mask, c, 0.0)
        buddies = r * c * weights[0][:, rows, None] * weights[1][:, None]
        slope = by_sums[0][..., None] + by_sums[1][..., None] * block.distances
        by_logit = 2 * slope * buddies - r * (weights[0] * row_shares)[:, rows, None]
        by_logit = by_logit - c * (weights[1] * column_shares)[:, None]
        collected.add(block, by_logit, by_sums[1][..., None] * buddies)
    return loss, collected.scene(row_shares, column_shares)


class _Collected:
    """Sums the gradient up, block by block."""

    def __init__(self, terms: SoftTerms, scene: Scene):
        self.terms, self.scene_given = terms, scene
        self.alpha = scene.temperature.to(scene.pair.P.dtype)[:, None, None]
        self.rows: dict[str, list[Tensor]] = {}
        self.columns: dict[str, Tensor] = {}
        self.temperature = torch.zeros_like(scene.temperature)
        self.rounding = torch.zeros_like(scene.rounding)

    def add(self, block: Block, by_logit: Tensor, by_distance: Tensor) -> None:
        """Add a block's share, from the derivatives by its logits and, buddies held, by its distances."""
        terms, by_matched = self.terms, -by_logit / self.alpha
        scaled = by_logit * block.matched / self.alpha.square()
        self.temperature = self.temperature + scaled.sum((-1, -2), dtype=torch.float64)
        if terms.match == "points":
            by_distance = by_distance + by_matched
        spatial = _over(by_distance, block.distances)
        if block.free is not None:
            spatial = torch.where(block.free, spatial, 0.0)
        self._round(spatial)
        if terms.match != "points":
            matched = _over(by_matched, block.matched)
            self._round(matched)
            self._features(block.pair, matched * terms.feature_weight**2)
            spatial = spatial + matched if terms.match == "both" else spatial
        if block.normals is None or block.residual is None:
            self._along(spatial, block.offsets)
            return
        force = spatial * block.residual
        self._along(force, block.normals)
        pushed = [force * x for x in block.offsets]
        self._put("Q_normals", torch.stack([x.sum(1) for x in pushed], -1))
        self._row("P_normals", torch.stack([(x * block.signs).sum(2) for x in pushed], -1))

    def _round(self, over_distance: Tensor) -> None:
        self.rounding = self.rounding + self.scene_given.rounding * over_distance.sum((-1, -2), dtype=torch.float64)

    def _along(self, factor: Tensor, directions: list[Tensor]) -> None:
        forces = [factor * x for x in directions]
        self._row("P", torch.stack([-x.sum(2) for x in forces], -1))
        self._put("Q", torch.stack([x.sum(1) for x in forces], -1))

    def _features(self, pair: CloudPair, factor: Tensor) -> None:
        P, Q = pair.P_features, pair.Q_features
        assert P is not None and Q is not None  # _matched_distances has asked for them
        P, Q, pulls = P.double(), Q.double(), factor.double()  # differences of products: precision is lost in them
        self._row("P_features", (pulls.sum(2)[..., None] * P - pulls @ Q).to(factor.dtype))
        self._put("Q_features", (pulls.sum(1)[..., None] * Q - pulls.mT @ P).to(factor.dtype))

    def _row(self, name: str, values: Tensor) -> None:
        self.rows.setdefault(name, []).append(values)

    def _put(self, name: str, values: Tensor) -> None:
        self.columns[name] = self.columns[name] + values if name in self.columns else values

    def scene(self, row_shares: Tensor, column_shares: Tensor) -> Scene:
        """The gradient; the derivatives by weights are the shares of rows and columns."""
        fields = {name: torch.cat(parts, 1) for name, parts in self.rows.items()} | self.columns
        pair = self.scene_given.pair
        if pair.P_weights is not None:
            fields["P_weights"] = row_shares
        if pair.Q_weights is not None:
            fields["Q_weights"] = column_shares
        return Scene(CloudPair._make(fields.get(name) for name in CloudPair._fields), self.temperature, self.rounding)


def _over(numerator: Tensor, distances: Tensor) -> Tensor:
    """``numerator / distances``; 0 where the distance is 0, whose derivative is defined as 0."""
    positive = distances > 0
    return torch.where(positive, numerator / torch.where(positive, distances, 1.0), 0.0)


def _weights(pair: CloudPair, side: str) -> Tensor:
    """Weights of the points of one cloud, ``(batch, n)``; 1 where none were given."""
    given = pair.P_weights if side == "P" else pair.Q_weights
    points = pair.P if side == "P" else pair.Q
    return points.new_ones(points.shape[:2]) if given is None else given


def _normalisers(terms: SoftTerms, scene: Scene, limit: Tensor | None) -> tuple[Tensor, Tensor]:
    """Logarithms of the denominators of Eq. 4, ``(batch, n)`` and ``(batch, m)``."""
    rows, columns = [], []
    for block, _ in blocks(terms, scene, limit):
        rows.append(log_normaliser(block.logits, -1, terms.outlier))
        columns.append(torch.logsumexp(block.logits, -2))
    total = torch.stack(columns, -2)
    return torch.cat(rows, 1)[..., 0], log_normaliser(total, -2, terms.outlier)[:, 0]


def _buddy_sums(
    terms: SoftTerms, scene: Scene, limit: Tensor | None, logs: tuple[Tensor, Tensor]
) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Per row, then per column: sum of buddies and of buddies times distance, weighted by the other side only."""
    row_parts: list[tuple[Tensor, Tensor]] = []
    column_parts: list[tuple[Tensor, Tensor]] = []
    P_weights, Q_weights = (_weights(scene.pair, side) for side in ("P", "Q"))
    for block, rows in blocks(terms, scene, limit):
        buddies = torch.exp(2 * block.logits - logs[0][:, rows, None] - logs[1][:, None])
        mask = block.pair.pair_mask()
        if mask is not None:
            buddies = torch.where(mask, buddies, 0.0)
        for parts, weights, dim in (
            (row_parts, Q_weights[:, None], 2),
            (column_parts, P_weights[:, rows, None], 1),
        ):
            weighted = buddies * weights
            parts.append((weighted.sum(dim), (weighted * block.distances).sum(dim)))
    row_sums = tuple(torch.cat([part[k] for part in row_parts], 1) for k in range(2))
    column_sums = tuple(sum((p[k] for p in column_parts[1:]), column_parts[0][k]) for k in range(2))
    return (row_sums[0], row_sums[1]), (column_sums[0], column_sums[1])
