"""The paper's metrics (Sec. "Evaluation Setup and Metrics") as torchmetrics, each with its 95 % interval.

States are counts, sums or the values themselves, so batches of any size add up to the same result.
`compute` returns a dictionary from metric name to value: the estimate and, with _low and _high, its interval.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from scipy import stats
from torch import Tensor
from torchmetrics import Metric, MetricCollection
from torchmetrics.utilities import dim_zero_cat

from conflow.scene.arms import Arms
from conflow.scene.constraint import Constraint
from conflow.scene.measures import (
    collision_intensity,
    endpoint_error,
    hand_path_length,
    joint_path_length,
    joint_smoothness,
    keeps,
    leaves_workspace,
    path_length,
    peak_acceleration,
    smoothness,
    squared_acceleration,
)
from conflow.scene.robots import Robots

Z = 1.959963984540054
"""The 97.5 % quantile of the standard normal: all intervals are 95 % intervals."""
BERTH = 0.1
"""Robots that come nearer to touching than this, in workspace units, count as near."""
REACHED = 0.01
"""Starts and goals count as reached within this `endpoint_error`, in workspace units per robot."""
OF_ARMS = (joint_smoothness, joint_path_length, hand_path_length)
"""What is measured of arms besides, under their names."""
BLOCK = 1024
"""Rows and columns of the distances held at a time: 8 MB, where all of 10,000 trajectories would take 800 MB."""


def wilson(count: int, total: int) -> tuple[float, float]:
    """Wilson's score interval of a rate count / total, 95 %: SciPy's.

    (p + z^2/2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2/n), with p = count / total and n = total. Where none
    are counted the lower end is 0, where all are the upper one is 1.
    """
    low, high = stats.binomtest(count, total).proportion_ci(method="wilson")
    return float(low), float(high)


def quantile_interval(values: Tensor, q: float) -> tuple[float, float]:
    """Distribution-free 95 % interval of the q-quantile: two order statistics.

    So many values lie below the quantile as heads fall, B ~ Binomial(n, q). The lower end is the highest order
    statistic that is above it with probability at most 2.5 %, and the upper end the lowest that is below it so
    seldom: SciPy's `quantile_test`. Where the sample is too small for an end it is the smallest or the largest value.

    Args:
        values: a sample (n,), in any order.
        q: in (0, 1).
    """
    n = len(values)
    below, above = stats.binom.ppf([0.025, 0.975], n, q)
    ranks = torch.tensor([int(below) - 1, int(above)]).clamp(0, n - 1)  # from 0 on
    low, high = values.sort().values[ranks].tolist()
    return low, high


def _blocks(x: Tensor) -> Sequence[Tensor]:
    """Trajectories (n, T, D) as rows of T D numbers, BLOCK at a time.

    In double precision, which not every accelerator has: cdist takes |x|^2 + |y|^2 - 2 <x, y>, which in single
    precision puts equal trajectories some 1e-3 apart, as much as the energy distance of a good model, and a collapsed
    one would look diverse.
    """
    return x.cpu().double().flatten(1).split(BLOCK)


def _mean_distances(x: Tensor) -> Tensor:
    """The mean distance |x_i - x_j| over all T D numbers of each of x (n, T, D) to the others, (n,)."""
    blocks = _blocks(x)
    sums = [torch.zeros(len(block), dtype=torch.float64) for block in blocks]
    for i, rows in enumerate(blocks):
        sums[i] += torch.cdist(rows, rows).sum(dim=1)
        for j, columns in enumerate(blocks[:i]):  # a pair of blocks counts for both
            d = torch.cdist(rows, columns)
            sums[i] += d.sum(dim=1)
            sums[j] += d.sum(dim=0)
    return torch.cat(sums) / (len(x) - 1)


def _mean_distances_between(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """The mean distance of each of x (n, T, D) to the y (m, T, D), (n,), and of each y to the x, (m,)."""
    to_y: list[Tensor] = []
    to_x = torch.zeros(len(y), dtype=torch.float64)
    for rows in _blocks(x):
        d = torch.cat([torch.cdist(rows, columns) for columns in _blocks(y)], dim=1)
        to_y.append(d.mean(dim=1))
        to_x += d.sum(dim=0)
    return torch.cat(to_y), to_x / len(x)


def _residual(x: Tensor, b: Tensor) -> Tensor:
    """E (|x - x'| - b(x) - b(x') + E b)^2 with b the mean distance to the others: what b does not say of distances.

    E|x - x'|^2 - 2 E b^2 + (E b)^2, whose first term is twice the trace of x's covariance.
    """
    return (2 * x.cpu().double().flatten(1).var(dim=0).sum() - 2 * (b * b).mean() + b.mean() ** 2).clamp_min(0)


ALONE = {"sync_on_compute": False}
"""Of several processes that train one measures, and must not wait for the others to measure too."""


class _Rate(Metric):
    """Fraction of trajectories that something holds for, with Wilson's interval.

    Computes `<name>_rate`, `_low`, `_high` and the `_count` behind them.
    """

    full_state_update = False
    count: Tensor
    total: Tensor

    def __init__(self, name: str) -> None:
        super().__init__(**ALONE)
        self.name = name
        self.add_state("count", torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")
        self.add_state("total", torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def add(self, holds: Tensor) -> None:
        """Take in for which trajectories it holds, boolean (batch,)."""
        self.count += holds.sum()
        self.total += len(holds)

    def compute(self) -> dict[str, float]:
        count, total = int(self.count), int(self.total)
        low, high = wilson(count, total)
        return {
            f"{self.name}_rate": count / total,
            f"{self.name}_low": low,
            f"{self.name}_high": high,
            f"{self.name}_count": count,
        }


class CollisionRate(_Rate):
    """Fraction of trajectories that violate a constraint at some waypoint."""

    def __init__(self, name: str, constraint: Constraint) -> None:
        super().__init__(name)
        self.constraint = constraint

    def update(self, x: Tensor) -> None:
        self.add(self.constraint.violation(x))


class SweptCollisionRate(CollisionRate):
    """As `CollisionRate`, with the robots on straight lines between the waypoints, which see a crossing there too."""

    def update(self, x: Tensor) -> None:
        self.add(~keeps(self.constraint, x))


class NearRate(_Rate):
    """Fraction of trajectories whose smallest clearance is below `BERTH`, collisions included.

    A low collision rate is cheap where everybody is kept far apart: beside that of the demonstrations it shows by how
    much.
    """

    def __init__(self, name: str, constraint: Constraint) -> None:
        super().__init__(name)
        self.constraint = constraint

    def update(self, x: Tensor) -> None:
        self.add(self.constraint.clearance(x).amin(dim=1) < BERTH)


class OutsideRate(_Rate):
    """Fraction of trajectories that leave the workspace at some waypoint."""

    def update(self, x: Tensor) -> None:
        self.add(leaves_workspace(x))


class SuccessRate(_Rate):
    """Fraction of trajectories that keep the constraint, stay in the workspace and reach the start and goal of x_1.

    The constraint is kept on the straight lines between the waypoints too. No collision rate can be bought here by
    going elsewhere or nowhere.
    """

    def __init__(self, name: str, constraint: Constraint) -> None:
        super().__init__(name)
        self.constraint = constraint

    def update(self, x: Tensor, x_1: Tensor) -> None:
        robots = self.constraint.robots
        reached = (endpoint_error(robots, x, x_1, 0) <= REACHED) & (endpoint_error(robots, x, x_1, -1) <= REACHED)
        self.add(reached & ~leaves_workspace(x) & keeps(self.constraint, x))


class _Values(Metric):
    """One number per trajectory, kept."""

    full_state_update = False
    values: list[Tensor]

    def __init__(self) -> None:
        super().__init__(**ALONE)
        self.add_state("values", [], dist_reduce_fx="cat")

    def quantiles(self, names: Mapping[str, float]) -> dict[str, float]:
        """The quantiles of these names, with the intervals of order statistics."""
        values = dim_zero_cat(self.values)
        result: dict[str, float] = {}
        for name, q in names.items():
            low, high = quantile_interval(values, q)
            result |= {name: float(values.quantile(q)), f"{name}_low": low, f"{name}_high": high}
        return result

    def mean(self, name: str) -> dict[str, float]:
        """The mean under this name, with its normal interval."""
        values = dim_zero_cat(self.values).cpu().double()
        mean, spread = float(values.mean()), Z * float(values.std()) / math.sqrt(len(values))
        return {name: mean, f"{name}_low": mean - spread, f"{name}_high": mean + spread}


class Smoothness(_Values):
    """Median and 95th percentile of `smoothness`, or of another reading of it, with intervals of order statistics."""

    def __init__(
        self, robots: Robots, name: str = "smoothness", reading: Callable[[Robots, Tensor], Tensor] = smoothness
    ) -> None:
        super().__init__()
        self.robots, self.name, self.reading = robots, name, reading

    def update(self, x: Tensor) -> None:
        self.values.append(self.reading(self.robots, x))

    def compute(self) -> dict[str, float]:
        return self.quantiles({f"{self.name}_median": 0.5, f"{self.name}_p95": 0.95})


class Median(_Values):
    """Median of a measure of trajectories, with the interval of order statistics.

    Of `path_length`: what stands still or wanders shows there.
    """

    def __init__(self, robots: Robots, name: str, measure: Callable[[Any, Tensor], Tensor]) -> None:
        super().__init__()
        self.robots, self.name, self.measure = robots, name, measure

    def update(self, x: Tensor) -> None:
        self.values.append(self.measure(self.robots, x))

    def compute(self) -> dict[str, float]:
        return self.quantiles({f"{self.name}_median": 0.5})


class CollisionIntensity(_Values):
    """Mean over trajectories of `collision_intensity`, with the normal interval of a mean."""

    def __init__(self, constraint: Constraint) -> None:
        super().__init__()
        self.constraint = constraint

    def update(self, x: Tensor) -> None:
        self.values.append(collision_intensity(self.constraint, x))

    def compute(self) -> dict[str, float]:
        return self.mean("collision_intensity")


class EndpointError(_Values):
    """Mean over trajectories of `endpoint_error`, with the normal interval of a mean.

    Args:
        robots: what moves.
        name: the metric's name.
        waypoint: 0 for the start, -1 for the goal.
    """

    def __init__(self, robots: Robots, name: str, waypoint: int) -> None:
        super().__init__()
        self.robots, self.name, self.waypoint = robots, name, waypoint

    def update(self, x: Tensor, x_1: Tensor) -> None:
        self.values.append(endpoint_error(self.robots, x, x_1, self.waypoint))

    def compute(self) -> dict[str, float]:
        return self.mean(self.name)


class Diversity(_Values):
    """Mean distance of two generated trajectories, |x - x'| over all T D numbers, with its normal interval.

    The mean over pairs is a U-statistic: with h_i the mean distance of trajectory i to the others, its variance is
    about 4 var(h) / n.
    """

    def update(self, x: Tensor) -> None:
        self.values.append(x)

    def compute(self) -> dict[str, float]:
        return self.estimate(_mean_distances(dim_zero_cat(self.values)))

    @staticmethod
    def estimate(h: Tensor) -> dict[str, float]:
        """From the mean distances h (n,)."""
        mean, spread = float(h.mean()), 2 * Z * float(h.std()) / math.sqrt(len(h))
        return {"diversity": mean, "diversity_low": mean - spread, "diversity_high": mean + spread}


class EnergyDistance(_Values):
    """2 E|X - Y| - E|X - X'| - E|Y - Y'| of generated trajectories X and a reference Y, over all T D numbers.

    0 where the laws are equal and positive elsewhere, so neither collapse nor leaving what was demonstrated escapes
    it. Estimated without the pairs of a trajectory with itself, hence without bias: around 0 it may be negative.

    Interval: with a_i the mean distance of x_i to the y, b_i that to the other x, and h_i = a_i - b_i, and likewise
    a_j, b_j and k_j for y_j, the estimate is mean(h) + mean(k). An x_i is in E|X - Y| once and in E|X - X'| on either
    side, so the estimate moves by 2 h_i / n, and its variance is 4 var(h) / n + 4 var(k) / m (Hoeffding's projections)
    while they dominate. At 0 they vanish and the statistic is degenerate; the variance of what is left there,
    2 (w_x / n + w_y / m)^2 with w^2 the `_residual` of each sample, is added. The interval stays approximate near 0:
    up to 1.6 times too wide at 0 itself, and on the low side where the distance is as small as its own noise.

    Args:
        reference: y, (m, T, D), independent of the x; at least two.
    """

    reference: Tensor

    def __init__(self, reference: Tensor) -> None:
        super().__init__()
        self.register_buffer("reference", reference, persistent=False)

    def update(self, x: Tensor) -> None:
        self.values.append(x)

    def compute(self) -> dict[str, float]:
        x = dim_zero_cat(self.values)
        return self.estimate(x, _mean_distances(x))

    def estimate(self, x: Tensor, b_x: Tensor) -> dict[str, float]:
        """Of x (n, T, D) with the mean distances b_x (n,) to each other."""
        y = self.reference
        n, m = len(x), len(y)
        (a_x, a_y), b_y = _mean_distances_between(x, y), _mean_distances(y)
        h, k = a_x - b_x, a_y - b_y
        distance = float(h.mean() + k.mean())
        degenerate = 2 * (_residual(x, b_x).sqrt() / n + _residual(y, b_y).sqrt() / m) ** 2
        spread = Z * math.sqrt(float(4 * h.var() / n + 4 * k.var() / m + degenerate))
        return {
            "energy_distance": distance,
            "energy_distance_low": distance - spread,
            "energy_distance_high": distance + spread,
        }


class DiversityAndEnergyDistance(EnergyDistance):
    """Both at once: the distances between generated trajectories, the most of the work, are the same."""

    def compute(self) -> dict[str, float]:
        x = dim_zero_cat(self.values)
        b_x = _mean_distances(x)
        return Diversity.estimate(b_x) | self.estimate(x, b_x)


def trajectory_metrics(
    judged: Mapping[str, Constraint], trained: Constraint, reference: Tensor | None, required: Constraint
) -> MetricCollection:
    """All metrics of generated trajectories x against the demonstrations x_1 whose starts and goals they were given.

    Args:
        judged: the task's constraints by name, each of which has a collision rate.
        trained: all that training keeps.
        reference: feasible demonstrations that were held out, (m, T, D), for the energy distance; None leaves it out.
        required: the constraint that a trajectory must keep to succeed.
    """
    robots = trained.robots
    metrics: dict[str, Metric | MetricCollection] = {
        **{f"{name}_collision": CollisionRate(f"{name}_collision", one) for name, one in judged.items()},
        **{f"{name}_swept": SweptCollisionRate(f"{name}_collision_swept", one) for name, one in judged.items()},
        "near": NearRate("near", trained),
        "success": SuccessRate("success", required),
        "outside": OutsideRate("outside"),
        "smoothness": Smoothness(robots),
        # What the paper calls smoothness it does not say; these are other readings, under their own names.
        "peak_acceleration": Smoothness(robots, "peak_acceleration", peak_acceleration),
        "squared_acceleration": Smoothness(robots, "squared_acceleration", squared_acceleration),
        "path_length": Median(robots, "path_length", path_length),
        "collision_intensity": CollisionIntensity(trained),
        "start_error": EndpointError(robots, "start_error", 0),
        "end_error": EndpointError(robots, "end_error", -1),
        "distances": Diversity() if reference is None else DiversityAndEnergyDistance(reference),
    }
    if isinstance(robots, Arms):
        metrics |= {measure.__name__: Median(robots, measure.__name__, measure) for measure in OF_ARMS}
    return MetricCollection(metrics, compute_groups=False)
