"""Fits the confidence to known answers, and judges it on data that it was not fitted to: table and diagram.

    python -m benchmarks.reliability --out docs/reliability

Reads ``benchmarks/reliability.csv`` of ``python -m benchmarks.reliability_runs``; needs no clouds. Each group of data
is judged by coefficients that were fitted to the other six.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np
from scipy.optimize import minimize
from scipy.stats import rankdata

from bbr_layer import atomic_write
from benchmarks.reliability_runs import read
from benchmarks.reliability_trials import LARGE

TABLE = Path("benchmarks/reliability.csv")
RIGHT_DEG, RIGHT_SHARE = 5.0, 0.05
# Weight of the squared coefficients beside the mean log loss, of shares scaled to unit deviation: few answers are
# neither plainly right nor plainly wrong, and without it the slope would grow with every trial.
PENALTY = 1e-4
BINS = 10
SURE = 0.9
# What the verdict of the command line was before: this share of close pairs and this share of buddies.
CLOSE_SHARE, FEWEST_BUDDIES = 0.75, 0.1


def loaded(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Group, right or not, the three shares, the share of close pairs, and the points of every registration."""
    rows = [row for _, row in sorted(read(path).items())]
    numbers = np.array([row[3:] for row in rows], dtype=float)
    right = (numbers[:, 0] <= RIGHT_DEG) & (numbers[:, 1] <= RIGHT_SHARE)
    points = np.array([int(row[1].split()[-3]) for row in rows])
    return np.array([row[0] for row in rows]), right, numbers[:, 2:5], numbers[:, 5], points


def fitted(shares: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Coefficients of 1 and of each share by logistic regression."""
    mean, deviation = shares.mean(0), shares.std(0)
    scaled = np.column_stack((np.ones(len(shares)), (shares - mean) / deviation))

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        logits = scaled @ weights
        slope = scaled.T @ (1 / (1 + np.exp(-logits)) - right) / len(right) + PENALTY * np.r_[0, weights[1:]]
        value = np.mean(np.logaddexp(0, logits) - right * logits) + PENALTY / 2 * np.sum(weights[1:] ** 2)
        return value, slope

    found = minimize(loss, np.zeros(scaled.shape[1]), jac=True, method="BFGS").x
    slopes = found[1:] / deviation
    return np.r_[found[0] - slopes @ mean, slopes]


def probability(weights: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """The confidence."""
    return 1 / (1 + np.exp(-(weights[0] + shares @ weights[1:])))


def held_out(groups: np.ndarray, right: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Each registration's confidence by a fit to the other groups."""
    found = np.zeros(len(groups))
    for group in np.unique(groups):
        out = groups == group
        found[out] = probability(fitted(shares[~out], right[~out]), shares[out])
    return found


def calibration(confidence: np.ndarray, right: np.ndarray) -> list[tuple[int, float, float]]:
    """Of each tenth of the confidences: how many, their mean, and the share that is right."""
    which = np.minimum((confidence * BINS).astype(int), BINS - 1)
    filled = [which == number for number in range(BINS) if (which == number).any()]
    return [(int(rows.sum()), confidence[rows].mean(), right[rows].mean()) for rows in filled]


def area(confidence: np.ndarray, right: np.ndarray) -> float:
    """Area under the ROC curve: how often a right answer has more confidence than a wrong one."""
    ranks, count = rankdata(confidence), right.sum()
    return (ranks[right].sum() - count * (count + 1) / 2) / (count * (~right).sum())


def row(name: str, confidence: np.ndarray, right: np.ndarray) -> str:
    """One table row."""
    error = sum(count * abs(mean - share) for count, mean, share in calibration(confidence, right)) / len(right)
    wrong = ~right
    cells = (name, len(right), wrong.sum(), f"{np.mean((confidence - right) ** 2):.4f}", f"{error:.3f}")
    cells += (f"{area(confidence, right):.4f}", (wrong & (confidence > SURE)).sum())
    cells += ((wrong & (confidence > 0.5)).sum(), (right & (confidence < 0.5)).sum())
    return "| " + " | ".join(map(str, cells)) + " |"


def diagram(path: Path, bins: list[tuple[int, float, float]]) -> None:
    """Share of right answers against confidence."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(4, 4), layout="constrained")
    axes.plot((0, 1), (0, 1), color="grey", linewidth=1)
    axes.plot([mean for _, mean, _ in bins], [share for _, _, share in bins], marker="o")
    for count, mean, share in bins:
        axes.annotate(str(count), (mean, share), xytext=(6, -12), textcoords="offset points", fontsize=8)
    axes.set(
        xlabel="confidence, held-out group", ylabel="share of right answers", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03)
    )
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=90)


def main() -> None:
    """Print and write table and diagram."""
    parser = argparse.ArgumentParser(description="fit and reliability of the confidence")
    parser.add_argument("--table", type=Path, default=TABLE)
    parser.add_argument("--out", type=Path, default=Path("docs/reliability"), help="names the .md and the .png")
    options = parser.parse_args()
    groups, right, shares, close, points = loaded(options.table)
    found, large = held_out(groups, right, shares), points == LARGE
    before = (close >= CLOSE_SHARE) & (shares[:, 0] >= FEWEST_BUDDIES)
    lines = [
        "Made by `python -m benchmarks.reliability`. Each group is judged by a fit to the others.",
        "",
        "| left out | registrations | wrong | Brier | calibration error | ROC area | wrong over 0.9 | wrong over 0.5 |"
        " right under 0.5 |",
        "|---|---|---|---|---|---|---|---|---|",
        *(row(group, found[groups == group], right[groups == group]) for group in np.unique(groups)),
        row("all", found, right),
        row(f"all of {LARGE} points", found[large], right[large]),
        "",
        f"The share of close pairs, from {CLOSE_SHARE} on, would trust {(before & ~right).sum()} wrong answers and "
        f"doubt {(~before & right).sum()} right ones; as a score its ROC area is {area(close, right):.4f}.",
        "",
        "Coefficients, of all: " + ", ".join(f"{number:.2f}" for number in fitted(shares, right)) + ".",
    ]
    print("\n".join(lines))
    with atomic_write(options.out.with_suffix(".md")) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    diagram(options.out.with_suffix(".png"), calibration(found, right))


if __name__ == "__main__":
    main()
