import math

import pytest
import torch
from scipy import stats
from torch import Tensor

from conflow.experiment.metrics import (
    CollisionRate,
    Diversity,
    EndpointError,
    Smoothness,
    SweptCollisionRate,
    endpoint_error,
    quantile_interval,
    smoothness,
    trajectory_metrics,
    wilson,
)
from conflow.scene.constraint import Obstacle, ObstacleAvoidance, RobotAvoidance
from conflow.scene.robots import PointRobots
from conflow.scene.trajectories import swap

ROBOTS = RobotAvoidance(PointRobots(2), 0.3)
OBSTACLE = ObstacleAvoidance(PointRobots(2), [Obstacle(0.0, 0.5, 0.1)], 0.15)


def parallel(gap: float, T: int = 5) -> Tensor:
    """Two robots that drive side by side along x at a constant speed, `gap` apart."""
    x = torch.zeros(1, T, 4)
    x[0, :, 0] = x[0, :, 2] = torch.linspace(-0.5, 0.5, T)
    x[0, :, 3] = -gap
    return x


@pytest.mark.parametrize(("count", "total"), [(0, 256), (4, 256), (13, 40), (256, 256), (1, 10_000)])
def test_wilsons_interval_is_scipys(count: int, total: int) -> None:
    oracle = stats.binomtest(count, total).proportion_ci(0.95, "wilson")
    assert wilson(count, total) == pytest.approx((oracle.low, oracle.high), abs=1e-12)


def test_the_quantile_interval_covers_the_quantile_as_often_as_it_says() -> None:
    generator = torch.Generator().manual_seed(0)
    intervals = [quantile_interval(torch.rand(500, generator=generator), 0.95) for _ in range(1000)]
    covered = sum(low <= 0.95 <= high for low, high in intervals)
    assert 930 <= covered <= 990  # at least 95 % by construction; three standard deviations of 1,000 draws are 21


def test_the_collision_rate_counts_hand_made_trajectories() -> None:
    metric = CollisionRate("robot_collision", ROBOTS)
    metric.update(torch.cat([parallel(0.29), parallel(0.31), parallel(0.5)]))
    metric.update(parallel(0.1))
    result = metric.compute()
    assert result["robot_collision_rate"] == 0.5
    assert result["robot_collision_count"] == 2
    assert (result["robot_collision_low"], result["robot_collision_high"]) == wilson(2, 4)


def test_one_waypoint_in_collision_is_a_collision() -> None:
    x = parallel(0.5)
    x[0, 3, 3] = -0.2
    assert ROBOTS.violation(x).tolist() == [True]


def test_the_object_collision_rate_counts_either_robot() -> None:
    metric = CollisionRate("object_collision", OBSTACLE)
    clear, first = parallel(0.5), parallel(0.5)
    first[0, :, 1] = 0.3  # 0.2 below the obstacle's centre, which touches at 0.25
    second = first[:, :, [2, 3, 0, 1]]
    metric.update(torch.cat([clear, first, second]))
    assert metric.compute()["object_collision_count"] == 2


def test_a_crossing_between_two_waypoints_is_a_swept_collision_alone() -> None:
    x = torch.zeros(1, 3, 4)
    x[0, :, 0] = torch.tensor([-0.9, -0.3, 0.3])
    x[0, :, 2] = -x[0, :, 0]  # 0.6 apart at the second and the third waypoint, in one place half-way between them
    at, swept = CollisionRate("at", ROBOTS), SweptCollisionRate("swept", ROBOTS)
    for metric in (at, swept):
        metric.update(x)
    assert at.compute()["at_rate"] == 0
    assert swept.compute()["swept_rate"] == 1


def test_smoothness_of_constant_speed_is_zero_and_of_a_parabola_its_acceleration() -> None:
    assert smoothness(parallel(0.4)).item() == pytest.approx(0, abs=1e-7)
    s = torch.arange(6.0)
    x = torch.zeros(1, 6, 4)
    x[0, :, 0], x[0, :, 1] = 0.03 * s**2, 0.04 * s**2  # second difference (0.06, 0.08), of norm 0.1
    assert smoothness(x).item() == pytest.approx(0.05)  # the other robot stands still


def test_endpoint_errors_are_distances_per_robot() -> None:
    x_1 = parallel(0.4)
    x = x_1.clone()
    x[0, 0, :2] += torch.tensor([0.03, 0.04])
    x[0, -1, 2:] += torch.tensor([0.0, 0.2])
    assert endpoint_error(x, x_1, 0).item() == pytest.approx(0.025)
    assert endpoint_error(x, x_1, -1).item() == pytest.approx(0.1)


def test_diversity_of_two_trajectories_is_their_distance_and_of_copies_zero() -> None:
    metric = Diversity()
    metric.update(torch.cat([parallel(0.4), parallel(0.6)]))
    assert metric.compute()["diversity"] == pytest.approx(0.2 * math.sqrt(5))
    copies = Diversity()
    copies.update(parallel(0.4).repeat(9, 1, 1))
    assert copies.compute()["diversity"] == pytest.approx(0, abs=1e-6)


def test_intervals_enclose_their_estimates_and_shrink_with_the_root_of_the_count() -> None:
    spreads = []
    for num in (400, 6400):
        metrics = [Smoothness(), EndpointError("start_error", 0), Diversity()]
        x, x_1 = swap(num, seed=1), swap(num, seed=2)
        results: dict[str, float] = {}
        for metric in metrics:
            metric.update(x, x_1) if isinstance(metric, EndpointError) else metric.update(x)
            results |= metric.compute()
        names = ["smoothness_median", "start_error", "diversity"]
        assert all(results[f"{name}_low"] < results[name] < results[f"{name}_high"] for name in names)
        spreads.append([results[f"{name}_high"] - results[f"{name}_low"] for name in names])
    # Sixteen times the data: a quarter of the width, up to the noise of a width, some 10 % at 400.
    assert all(3 < wide / narrow < 5.3 for wide, narrow in zip(*spreads, strict=True))


def test_metrics_do_not_depend_on_how_the_trajectories_were_split_over_batches() -> None:
    x, x_1 = swap(300, seed=1), swap(300, seed=2)
    whole, parts = trajectory_metrics(ROBOTS, OBSTACLE), trajectory_metrics(ROBOTS, OBSTACLE)
    whole.update(x=x, x_1=x_1)
    for a, b in zip(x.split([1, 99, 200]), x_1.split([1, 99, 200]), strict=True):
        parts.update(x=a, x_1=b)
    one, other = whole.compute(), parts.compute()
    assert one.keys() == other.keys()
    assert all(one[key] == pytest.approx(other[key], rel=1e-12) for key in one)
