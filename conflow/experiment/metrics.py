"""The paper's metrics (Sec. "Evaluation Setup and Metrics") as torchmetrics, each with its 95 % interval.

States are counts, sums or the values themselves, so batches of any size add up to the same result.
`compute` returns a dictionary from metric name to value: the estimate and, with _low and _high, its interval.
"""

import math

import torch
from torch import Tensor
from torchmetrics import Metric, MetricCollection
from torchmetrics.utilities import dim_zero_cat

from conflow.scene.constraint import Constraint

Z = 1.959963984540054
"""The 97.5 % quantile of the standard normal: all intervals are 95 % intervals."""


def wilson(count: float, total: float) -> tuple[float, float]:
    """Wilson's score interval of a rate count / total.

    (p + z^2/2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2/n), with p = count / total and n = total.
    """
    p, n = count / total, total
    centre, spread = p + Z**2 / (2 * n), Z * math.sqrt(p * (1 - p) / n + Z**2 / (4 * n**2))
    # At 0 and n the ends are 0 and 1, which rounding would miss.
    low = 0.0 if count == 0 else (centre - spread) / (1 + Z**2 / n)
    high = 1.0 if count == total else (centre + spread) / (1 + Z**2 / n)
    return low, high


def quantile_interval(values: Tensor, q: float) -> tuple[float, float]:
    """Distribution-free interval of the q-quantile: order statistics at n q -+ z sqrt(n q (1 - q))."""
    n = len(values)
    spread = Z * math.sqrt(n * q * (1 - q))
    ranks = torch.tensor([math.floor(n * q - spread), math.ceil(n * q + spread)]).clamp(0, n - 1)
    low, high = values.sort().values[ranks].tolist()
    return low, high


def smoothness(x: Tensor) -> Tensor:
    """Mean over waypoints and robots of the norm of the second difference of positions, (batch,).

    1 / (T - 2) sum_i |q_{i+1} - 2 q_i + q_{i-1}| for x (batch, T, D) with two coordinates per robot, in
    workspace units per waypoint squared: smaller is smoother.
    """
    acceleration = x[:, 2:] - 2 * x[:, 1:-1] + x[:, :-2]
    return torch.linalg.vector_norm(_positions(acceleration), dim=3).mean(dim=(1, 2))


def endpoint_error(x: Tensor, x_1: Tensor, waypoint: int) -> Tensor:
    """Mean over robots of the distance between x and x_1 (batch, T, D) at a waypoint, (batch,)."""
    return torch.linalg.vector_norm(_positions(x - x_1)[:, waypoint], dim=2).mean(dim=1)


def _positions(x: Tensor) -> Tensor:
    """Each robot's coordinates, (batch, T, robots, 2)."""
    return x.reshape(*x.shape[:2], -1, 2)


class CollisionRate(Metric):
    """Fraction of trajectories that violate a constraint at some waypoint, with Wilson's interval.

    Computes `<name>_rate`, `_low`, `_high` and the `_count` behind them.
    """

    full_state_update = False
    violations: Tensor
    total: Tensor

    def __init__(self, name: str, constraint: Constraint) -> None:
        super().__init__()
        self.name, self.constraint = name, constraint
        self.add_state("violations", torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")
        self.add_state("total", torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def update(self, x: Tensor) -> None:
        self.violations += self.violates(x).sum()
        self.total += len(x)

    def violates(self, x: Tensor) -> Tensor:
        """What counts, boolean (batch,)."""
        return self.constraint.violation(x)

    def compute(self) -> dict[str, float]:
        count, total = int(self.violations), int(self.total)
        low, high = wilson(count, total)
        return {
            f"{self.name}_rate": count / total,
            f"{self.name}_low": low,
            f"{self.name}_high": high,
            f"{self.name}_count": count,
        }


class SweptCollisionRate(CollisionRate):
    """As `CollisionRate`, with the robots on straight lines between the waypoints, which see a crossing there too."""

    def violates(self, x: Tensor) -> Tensor:
        return ~(self.constraint.swept_clearance(x).amin(dim=1) >= 0)


class _Values(Metric):
    """One number per trajectory, kept."""

    full_state_update = False
    values: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        self.add_state("values", [], dist_reduce_fx="cat")


class Smoothness(_Values):
    """Median and 95th percentile of `smoothness`, with the intervals of order statistics."""

    def update(self, x: Tensor) -> None:
        self.values.append(smoothness(x))

    def compute(self) -> dict[str, float]:
        values = dim_zero_cat(self.values)
        result: dict[str, float] = {}
        for name, q in {"smoothness_median": 0.5, "smoothness_p95": 0.95}.items():
            low, high = quantile_interval(values, q)
            result |= {name: float(values.quantile(q)), f"{name}_low": low, f"{name}_high": high}
        return result


class EndpointError(_Values):
    """Mean over trajectories of `endpoint_error`, with the normal interval of a mean.

    Args:
        name: the metric's name.
        waypoint: 0 for the start, -1 for the goal.
    """

    def __init__(self, name: str, waypoint: int) -> None:
        super().__init__()
        self.name, self.waypoint = name, waypoint

    def update(self, x: Tensor, x_1: Tensor) -> None:
        self.values.append(endpoint_error(x, x_1, self.waypoint))

    def compute(self) -> dict[str, float]:
        values = dim_zero_cat(self.values).double()
        mean, spread = float(values.mean()), Z * float(values.std()) / math.sqrt(len(values))
        return {self.name: mean, f"{self.name}_low": mean - spread, f"{self.name}_high": mean + spread}


class Diversity(_Values):
    """Mean distance of two generated trajectories, |x - x'| over all T D numbers, with its normal interval.

    The mean over pairs is a U-statistic: with h_i the mean distance of trajectory i to the others, its variance is
    about 4 var(h) / n.
    """

    def update(self, x: Tensor) -> None:
        self.values.append(x.flatten(1))

    def compute(self) -> dict[str, float]:
        x = dim_zero_cat(self.values).double()
        n = len(x)
        h = torch.cdist(x, x).sum(dim=1) / (n - 1)
        mean, spread = float(h.mean()), 2 * Z * float(h.std()) / math.sqrt(n)
        return {"diversity": mean, "diversity_low": mean - spread, "diversity_high": mean + spread}


def trajectory_metrics(robots: Constraint, obstacle: Constraint) -> MetricCollection:
    """All metrics of generated trajectories x against the demonstrations x_1 whose starts and goals they were given."""
    return MetricCollection(
        {
            "robot_collision": CollisionRate("robot_collision", robots),
            "object_collision": CollisionRate("object_collision", obstacle),
            "robot_collision_swept": SweptCollisionRate("robot_collision_swept", robots),
            "smoothness": Smoothness(),
            "start_error": EndpointError("start_error", 0),
            "end_error": EndpointError("end_error", -1),
            "diversity": Diversity(),
        },
        compute_groups=False,
    )
