import math
from collections.abc import Callable
from math import pi
from statistics import fmean, stdev

import pytest
import torch
from scipy import stats
from torch import Tensor

from conflow.scene.arms import Arms, Base, Body, Chain
from conflow.scene.constraint import SpeedLimit, Sum, Workspace
from conflow.scene.measures import (
    collision_intensity,
    endpoint_error,
    hand_path_length,
    joint_path_length,
    joint_smoothness,
    path_length,
    peak_acceleration,
    smoothness,
    squared_acceleration,
)
from conflow.scene.robots import Discs
from conflow.scene.settings import Obstacle
from conflow.scene.tasks.swap import swap
from conflow.training import metrics as metrics_module
from conflow.training.metrics import (
    CollisionRate,
    Diversity,
    EndpointError,
    EnergyDistance,
    Median,
    NearRate,
    OutsideRate,
    Smoothness,
    SuccessRate,
    SweptCollisionRate,
    quantile_interval,
    trajectory_metrics,
    wilson,
)
from tests.papers import TWO, keep_apart, keep_clear

ROBOTS = keep_apart(2, 0.3)
OBSTACLE = keep_clear(2, [Obstacle(0.0, 0.5, 0.1)], 0.15)


def parallel(gap: float, T: int = 5) -> Tensor:
    """Two robots that drive side by side along x at a constant speed, `gap` apart."""
    x = torch.zeros(1, T, 4)
    x[0, :, 0] = x[0, :, 2] = torch.linspace(-0.5, 0.5, T)
    x[0, :, 3] = -gap
    return x


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


def test_the_obstacle_between_two_waypoints_is_a_swept_collision_alone() -> None:
    """Under the names that the constraints have, each at waypoints and on the way."""
    x = parallel(0.5, T=4)
    x[0, :, 0] = x[0, :, 2] = torch.tensor([-0.9, -0.3, 0.3, 0.9])
    x[0, :, 1] = 0.4  # past (0, 0.5) in the middle of a step
    metrics = trajectory_metrics({"robot": ROBOTS, "object": OBSTACLE}, ROBOTS, None, ROBOTS)
    metrics.update(x=x.repeat(2, 1, 1), x_1=x.repeat(2, 1, 1))
    found = {key: value for key, value in metrics.compute().items() if "_collision" in key}
    names = [f"{one}_collision{swept}" for one in ("robot", "object") for swept in ("", "_swept")]
    assert found.keys() == {f"{name}_{part}" for name in names for part in ("rate", "low", "high", "count")}
    assert [found[f"{name}_count"] for name in names] == [0, 0, 0, 2]


def test_one_robot_is_measured_as_two_are() -> None:
    """Of a straight line at constant speed 1 in a world with walls and a limit that it keeps."""
    one = Discs(1)
    judged = {"walls": Workspace(one), "speed": SpeedLimit(one, 1.5, dt=0.25)}
    kept = Sum([*judged.values()])
    metrics = trajectory_metrics(judged, kept, None, kept)
    x = parallel(0.0)[..., :2].repeat(3, 1, 1)
    x[2, -1, 0] = 0.9  # too far in the last step
    metrics.update(x=x, x_1=x)
    found = metrics.compute()
    assert [found[f"{name}_collision_count"] for name in judged] == [0, 1]
    assert found["success_count"] == 2
    assert found["path_length_median"] == pytest.approx(1)
    assert found["smoothness_median"] == pytest.approx(0, abs=1e-7)


def test_smoothness_of_constant_speed_is_zero_and_of_a_parabola_its_acceleration() -> None:
    assert smoothness(TWO, parallel(0.4)).item() == pytest.approx(0, abs=1e-7)
    s = torch.arange(6.0)
    x = torch.zeros(1, 6, 4)
    x[0, :, 0], x[0, :, 1] = 0.03 * s**2, 0.04 * s**2  # second difference (0.06, 0.08), of norm 0.1
    assert smoothness(TWO, x).item() == pytest.approx(0.05)  # the other robot stands still
    assert peak_acceleration(TWO, x).item() == pytest.approx(0.05)
    assert squared_acceleration(TWO, x).item() == pytest.approx(0.005)


def test_a_single_kink_shows_in_full_in_the_peak_and_diluted_in_the_mean() -> None:
    """Positions 0, 0, 0, 1, 2, 3 of one robot: one second difference of 1 among four, the other robot stands still."""
    x = torch.zeros(1, 6, 4)
    x[0, :, 0] = torch.tensor([0.0, 0.0, 0.0, 1.0, 2.0, 3.0])
    assert smoothness(TWO, x).item() == pytest.approx(1 / 8)
    assert peak_acceleration(TWO, x).item() == pytest.approx(1 / 2)
    assert squared_acceleration(TWO, x).item() == pytest.approx(1 / 8)


def test_joints_that_turn_at_constant_speed_are_smooth_and_hands_go_along_arcs() -> None:
    """Two arms of one link of a metre: the first turns by a right angle, the second stands still."""
    link = Chain(((0, 0, 0),), (-pi,), (pi,), (2.0,), [Body(1, [(1, 0, 0, 0.05)])], hand=(1.0, 0.0, 0.0))
    arms, T = Arms([link, link], [Base(-2), Base(2)], axes=2), 50
    x = torch.zeros(1, T, 2)
    x[0, :, 0] = torch.linspace(0, 0.5, T)  # of a range of pi
    assert joint_smoothness(arms, x).item() == pytest.approx(0, abs=1e-6)
    assert joint_path_length(arms, x).item() == pytest.approx(pi / 2)
    assert hand_path_length(arms, x).item() == pytest.approx(pi / 4, rel=1e-4)  # the mean of an arc and of nothing
    x[0, :, 1] = 0.01 * torch.arange(T) ** 2 / T
    assert joint_smoothness(arms, x).item() == pytest.approx(0.02 * pi / T, rel=1e-4)
    found = {}
    for robots in (arms, TWO):
        kept = Workspace(robots)
        metrics = trajectory_metrics({"limits": kept}, kept, None, kept)
        some = torch.zeros(3, T, robots.D)
        metrics.update(x=some, x_1=some)
        found[robots] = metrics.compute()
    assert {key for key in found[arms] if key.endswith("_median")} - found[TWO].keys() == {
        *("joint_smoothness_median", "joint_path_length_median", "hand_path_length_median")
    }


def test_collision_intensity_is_the_share_of_waypoints_in_violation() -> None:
    x = parallel(0.4).repeat(3, 1, 1)
    x[0, :2, 3] = x[0, :2, 1]  # two of five waypoints on top of each other
    x[1, 4] = math.nan
    assert collision_intensity(ROBOTS, x).tolist() == pytest.approx([2 / 5, 1 / 5, 0])
    metrics = trajectory_metrics({"robot": ROBOTS}, ROBOTS, None, ROBOTS)
    metrics.update(x=x[[0, 2, 2]], x_1=x[[0, 2, 2]])
    found = metrics.compute()
    # 2/5, 0, 0: the mean is 2/15 and the standard deviation 2 / (5 sqrt 3), over sqrt 3.
    assert found["collision_intensity"] == pytest.approx(2 / 15)
    assert found["collision_intensity_high"] - found["collision_intensity"] == pytest.approx(1.959964 * 2 / 15)


def test_endpoint_errors_are_distances_per_robot() -> None:
    x_1 = parallel(0.4)
    x = x_1.clone()
    x[0, 0, :2] += torch.tensor([0.03, 0.04])
    x[0, -1, 2:] += torch.tensor([0.0, 0.2])
    assert endpoint_error(TWO, x, x_1, 0).item() == pytest.approx(0.025)
    assert endpoint_error(TWO, x, x_1, -1).item() == pytest.approx(0.1)


def test_diversity_of_two_trajectories_is_their_distance_and_of_copies_zero() -> None:
    metric = Diversity()
    metric.update(torch.cat([parallel(0.4), parallel(0.6)]))
    assert metric.compute()["diversity"] == pytest.approx(0.2 * math.sqrt(5))
    copies = Diversity()
    copies.update(parallel(0.4).repeat(9, 1, 1))
    assert copies.compute()["diversity"] == pytest.approx(0, abs=1e-6)


def test_path_lengths_of_a_straight_line_a_half_circle_and_a_robot_that_stands_still() -> None:
    assert path_length(TWO, parallel(0.4)).item() == pytest.approx(1)
    T = 40
    angle = torch.linspace(0, math.pi, T)
    x = torch.zeros(1, T, 4)
    x[0, :, 0], x[0, :, 1] = 0.5 * angle.cos(), 0.5 * angle.sin()
    # Chords of the half circle of radius 1/2, whose arc is pi/2; the other robot stands still.
    chords = (T - 1) * math.sin(math.pi / 2 / (T - 1))
    assert path_length(TWO, x).item() == pytest.approx(chords / 2, rel=1e-5)
    assert path_length(TWO, x).item() == pytest.approx(math.pi / 4, rel=1e-3)
    metric = Median(TWO, "path_length", path_length)
    metric.update(torch.cat([x, parallel(0.4, T), x]))
    result = metric.compute()
    assert result["path_length_median"] == pytest.approx(chords / 2, rel=1e-5)
    assert (result["path_length_median_low"], result["path_length_median_high"]) == pytest.approx((chords / 2, 1))


def test_leaving_the_workspace_counts_from_one_coordinate_of_one_waypoint_on() -> None:
    x = parallel(0.5).repeat(4, 1, 1)
    x[0, 2, 3] = -1  # on the edge
    x[1, 2, 3] = -1.001
    x[2, 4, 0] = 1.001
    x[3, 1, 1] = math.nan
    metric = OutsideRate("outside")
    metric.update(x)
    result = metric.compute()
    assert (result["outside_rate"], result["outside_count"]) == (0.75, 3)
    assert (result["outside_low"], result["outside_high"]) == wilson(3, 4)


def touching(x: Tensor) -> None:
    x[0, 2, 3] = -0.2


def outside(x: Tensor) -> None:
    x[0, 2, 3] = -1.1


def late_start(x: Tensor) -> None:
    x[0, 0, 0] += 0.021  # 0.0105 in the mean of both robots


def missed_goal(x: Tensor) -> None:
    x[0, -1, 3] -= 0.021


def lost(x: Tensor) -> None:
    x[0, 2, 2] = math.nan


def within_tolerance(x: Tensor) -> None:
    x[0, 0, 0] += 0.019


def crossing_between_waypoints(x: Tensor) -> None:
    """The robots change sides in one step: far apart before and after, through each other in between."""
    x[0, 1, 1], x[0, 1, 3] = x[0, 1, 3].clone(), x[0, 1, 1].clone()


@pytest.mark.parametrize(
    ("spoil", "count"),
    [
        *((within_tolerance, 1), (touching, 0), (outside, 0), (late_start, 0), (missed_goal, 0), (lost, 0)),
        (crossing_between_waypoints, 0),
    ],
)
def test_success_takes_all_of_it(spoil: Callable[[Tensor], None], count: int) -> None:
    x_1, x = parallel(0.5), parallel(0.5)
    spoil(x)
    metric = SuccessRate("success", ROBOTS)
    metric.update(x, x_1)
    assert metric.compute()["success_count"] == count


def test_no_trajectory_both_succeeds_around_the_obstacle_and_hits_it() -> None:
    """What succeeds with the obstacle to keep succeeds without it and never touches it on its straight lines."""
    x = swap(300, seed=1)
    alone, around = (
        trajectory_metrics({"robot": ROBOTS, "object": OBSTACLE}, ROBOTS, None, kept)
        for kept in (ROBOTS, Sum([ROBOTS, OBSTACLE]))
    )
    free = OBSTACLE.swept_clearance(x).amin(dim=1) >= 0
    for each in (alone, around):
        each.update(x=x, x_1=x)
    found = around.compute()
    assert found["success_rate"] + found["object_collision_rate"] <= 1
    apart = trajectory_metrics({"robot": ROBOTS, "object": OBSTACLE}, ROBOTS, None, ROBOTS)
    apart.update(x=x[free], x_1=x[free])
    assert found["success_count"] == apart.compute()["success_count"]
    assert 0 < found["success_count"] < alone.compute()["success_count"]


def distances(x: Tensor, y: Tensor) -> list[float]:
    """|x_i - y_j| of all pairs but those of a trajectory with itself, one by one."""
    return [(a - b).norm().item() for a in x.double() for b in y.double() if a is not b and not torch.equal(a, b)]


def energy(x: Tensor, y: Tensor) -> dict[str, float]:
    metric = EnergyDistance(y)
    metric.update(x)
    return metric.compute()


def test_the_energy_distance_is_that_of_all_pairs() -> None:
    x, y = swap(7, T=5, seed=1), swap(9, T=5, seed=2)
    oracle = 2 * fmean(distances(x, y)) - fmean(distances(x, x)) - fmean(distances(y, y))
    assert energy(x, y)["energy_distance"] == pytest.approx(oracle, rel=1e-9)


def test_the_energy_distance_is_scipys_but_for_the_pairs_of_one_with_itself() -> None:
    x, y = torch.randn(30, 1, 1), 2 * torch.randn(40, 1, 1) + 0.5
    # scipy's mean over all pairs, diagonal included, is (n - 1) / n of ours within x, and its distance is the root.
    diagonal = fmean(distances(x, x)) / 30 + fmean(distances(y, y)) / 40
    oracle = stats.energy_distance(x.flatten().numpy(), y.flatten().numpy()) ** 2
    assert energy(x, y)["energy_distance"] == pytest.approx(oracle - diagonal, rel=1e-6)


def test_pairs_are_the_same_where_rows_come_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    x, y = swap(100, seed=1), swap(90, seed=2)
    diversity = Diversity()
    diversity.update(x)
    whole = energy(x, y) | diversity.compute()
    monkeypatch.setattr(metrics_module, "BLOCK", 7)
    diversity = Diversity()
    diversity.update(x)
    assert energy(x, y) | diversity.compute() == pytest.approx(whole, abs=1e-8)


def test_the_energy_distance_of_a_collapsed_model_is_seen_to_single_precision() -> None:
    copies, y = swap(1, seed=1).repeat(100, 1, 1), swap(100, seed=2)
    oracle = 2 * fmean(distances(copies[:1], y)) - fmean(distances(y, y))
    assert energy(copies, y)["energy_distance"] == pytest.approx(oracle, abs=1e-6)
    assert energy(copies, y)["energy_distance_low"] > 0.1


@pytest.mark.parametrize(("shift", "covered"), [(0.0, (0.97, 1.0)), (0.5, (0.88, 0.97)), (1.0, (0.92, 0.98))])
def test_the_interval_of_the_energy_distance_covers_it(shift: float, covered: tuple[float, float]) -> None:
    """Standard normals in one dimension: |X - Y| is folded normal."""
    truth = 2 * stats.foldnorm.mean(shift / math.sqrt(2), scale=math.sqrt(2)) - 4 / math.sqrt(math.pi)
    generator = torch.Generator().manual_seed(0)
    results = [
        energy(torch.randn(200, 1, 1, generator=generator) + shift, torch.randn(100, 1, 1, generator=generator))
        for _ in range(400)
    ]
    low, high = covered
    assert low <= fmean(r["energy_distance_low"] <= truth <= r["energy_distance_high"] for r in results) <= high
    values = [r["energy_distance"] for r in results]
    assert fmean(values) == pytest.approx(truth, abs=4 * stdev(values) / math.sqrt(len(values)))


@pytest.mark.parametrize("name", ["diversity", "start_error"])
def test_the_intervals_of_means_cover_them(name: str) -> None:
    """Standard normals in the plane: two are sqrt(pi) apart on average, and sqrt(pi / 2) from the origin."""
    truth = {"diversity": math.sqrt(math.pi), "start_error": math.sqrt(math.pi / 2)}[name]
    generator = torch.Generator().manual_seed(0)
    covered = []
    for _ in range(400):
        x = torch.randn(200, 1, 2, generator=generator)
        metric = Diversity() if name == "diversity" else EndpointError(TWO, name, 0)
        metric.update(x) if isinstance(metric, Diversity) else metric.update(x, torch.zeros_like(x))
        result = metric.compute()
        covered.append(result[f"{name}_low"] <= truth <= result[f"{name}_high"])
    # 0.95 within four standard deviations of a share of 400; half the width would cover two thirds.
    assert 0.905 < fmean(covered) <= 0.99


def test_the_energy_distance_grows_with_a_shift() -> None:
    x, y = swap(400, seed=1), swap(300, seed=2)
    shifted = [energy(x + shift, y)["energy_distance"] for shift in (0.0, 0.05, 0.1, 0.2)]
    assert shifted == sorted(shifted)
    assert shifted[0] < 0.05 < shifted[1] * 20


def test_intervals_enclose_their_estimates_and_shrink_with_the_root_of_the_count() -> None:
    spreads = []
    for num in (400, 6400):
        metrics = [Smoothness(TWO), EndpointError(TWO, "start_error", 0), Diversity()]
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
    reference = swap(200, seed=3)
    whole, parts = (
        trajectory_metrics({"robot": ROBOTS, "object": OBSTACLE}, ROBOTS, reference, ROBOTS) for _ in range(2)
    )
    whole.update(x=x, x_1=x_1)
    for a, b in zip(x.split([1, 99, 200]), x_1.split([1, 99, 200]), strict=True):
        parts.update(x=a, x_1=b)
    one, other = whole.compute(), parts.compute()
    assert one.keys() == other.keys()
    assert {"success_rate", "outside_rate", "path_length_median", "energy_distance"} <= one.keys()
    assert all(one[key] == pytest.approx(other[key], rel=1e-9) for key in one)


def test_without_a_reference_there_is_no_energy_distance_and_all_else() -> None:
    x = swap(50, seed=1)
    without, with_one = (
        trajectory_metrics({"robot": ROBOTS, "object": OBSTACLE}, ROBOTS, reference, ROBOTS) for reference in (None, x)
    )
    for each in (without, with_one):
        each.update(x=x, x_1=x)
    left_out = with_one.compute().keys() - without.compute().keys()
    assert left_out == {"energy_distance", "energy_distance_low", "energy_distance_high"}


def test_near_is_what_comes_nearer_than_the_berth_whether_it_collides_or_not() -> None:
    """Robots 0.3 wide that keep 0.2, 0.39 and 0.41 between their centres: two of three are near."""
    metric = NearRate("near", ROBOTS)
    d = torch.tensor([0.2, 0.39, 0.41])[:, None].expand(3, 5)
    metric.update(torch.stack([d, 0 * d, 0 * d, 0 * d], dim=2))
    found = metric.compute()
    assert found["near_count"] == 2
    assert found["near_rate"] == pytest.approx(2 / 3)
