"""The planner with small untrained networks; where the network's output is zero, the flow stands still."""

import math
import pickle
import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle
from torch import Tensor

from conflow.errors import ConfigError
from conflow.figures.plans import picture
from conflow.figures.workspace import NAMED
from conflow.flow.sampler import PIECE
from conflow.flow.source import Source, rbf
from conflow.planner import DescentPlanner, PlanError, Planner, Plans, _ranked, exact
from conflow.scene.constraint import Constraint, ObstacleAvoidance, RobotAvoidance
from conflow.scene.demonstrations import Demonstrations
from conflow.scene.robots import Discs, Robots
from conflow.scene.settings import Obstacle
from conflow.scene.task import SceneTask, Task
from conflow.scene.tasks.maps import Room
from conflow.scene.tasks.pandas import Pandas
from conflow.scene.tasks.swap import swap
from conflow.scene.tasks.weave import Weave
from conflow.tracking import store
from conflow.training import config
from conflow.training.build import fitted, random_stream
from conflow.training.model import ConFlow
from conflow.training.model_file import load_model
from tests.conftest import Typed
from tests.papers import keep_apart, model_of
from tests.test_closed_forms import Balls

T, D = 32, 4
START, GOAL = (-0.8, 0.0, 0.8, 0.0), (0.8, 0.0, -0.8, 0.0)
VIA = [(0.5, (0.1, 0.6, -0.1, -0.6)), (0.26, (-0.3, 0.37, 0.41, -0.32))]
DISC = (0.0, 0.0, 0.1)
SOURCES = ("cgp", "gp", "gaussian")


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """So small a network gains nothing from threads, and on a busy machine they wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def planner(*arguments: str, still: bool = False) -> Planner:
    torch.manual_seed(0)
    model = model_of(config.load(["preset=smoke", *arguments]), T, D)
    if still:
        torch.nn.init.zeros_(model.v.outlet.weight)
        torch.nn.init.zeros_(model.v.outlet.bias)
    return Planner(model)


def save(model: ConFlow, path: Path) -> Path:
    """What of a run's checkpoint is read."""
    described = {"config": model.config.tree(), "T": model.T, "D": model.D, "scale": 1.0, "offset": 0.0}
    torch.save({"conflow": described, "state_dict": model.state_dict()}, path)
    return path


def clearance(x: Tensor, obstacles: list[tuple[float, float, float]], radius: float = 0.3) -> float:
    """The smallest gap of one trajectory (T, 4), at 200 moments from each waypoint to the next."""
    gaps = []
    for x1, y1, x2, y2 in (
        torch.lerp(x[:-1, None], x[1:, None], torch.linspace(0, 1, 200)[:, None]).flatten(0, 1).tolist()
    ):
        gaps.append(math.hypot(x1 - x2, y1 - y2) - radius)
        gaps += [
            math.hypot(px - ox, py - oy) - r - radius / 2 for px, py in ((x1, y1), (x2, y2)) for ox, oy, r in obstacles
        ]
    return min(gaps)


@pytest.mark.parametrize("kind", SOURCES)
@pytest.mark.parametrize("guidance", ["none", "all"])
def test_start_goal_and_via_points_are_met_to_the_last_bit(kind: str, guidance: Any) -> None:
    pairs = swap(3)
    starts, goals = pairs[:, 0].double() / 3 * 3, pairs[:, -1]
    x = planner(f"source.kind={kind}").plan(starts, goals, 5, [DISC], VIA, guidance).x
    assert x.shape == (3, 5, T, D)
    assert torch.equal(x[:, :, 0], starts.float()[:, None].expand(-1, 5, -1))
    assert torch.equal(x[:, :, -1], goals[:, None].expand(-1, 5, -1))
    for waypoint, (_, position) in zip((16, 8), VIA, strict=True):  # 0.5 * 31 and 0.26 * 31, rounded
        assert torch.equal(x[:, :, waypoint], torch.tensor(position).expand(3, 5, -1))


def test_a_via_point_next_to_an_end_falls_on_an_inner_waypoint() -> None:
    first, last = (-0.75, 0.05, 0.75, 0.05), (0.75, 0.05, -0.75, 0.05)
    plans = planner().plan(START, GOAL, 2, via=[(1e-6, first), (0.999, last)])
    assert torch.equal(plans.x[:, 1], torch.tensor(first).expand(2, -1))
    assert torch.equal(plans.x[:, -2], torch.tensor(last).expand(2, -1))


def test_where_the_flow_stands_still_plans_are_samples_of_the_source_conditioned_on_the_request() -> None:
    """And since nothing is missing at the waypoints, making them exact changes nothing."""
    index = (0, 16, 8, -1)
    y = torch.tensor([START, *(position for _, position in VIA), GOAL]).expand(50, -1, -1)
    x_0 = Source(rbf(T, 0.4, 1.0, 1e-6), index).sample(y, random_stream("plan", 3))
    x = planner(still=True).plan(START, GOAL, 50, via=VIA, guidance="none", seed=3).x
    assert torch.equal(x.flatten(1).sort(dim=0).values, x_0.flatten(1).sort(dim=0).values)


def test_exactness_adds_the_conditional_mean_of_what_is_missing() -> None:
    """x + K_:O K_OO^-1 (y - x_O), solved densely here."""
    K, index = rbf(T, 0.4, 1.0, 1e-6), [0, 10, 31]
    x, y = torch.randn(6, T, D).double(), torch.randn(6, 3, D).double()
    expected = x + K[:, index] @ K[index][:, index].inverse() @ (y - x[:, index])
    # A 3 x 3 matrix with condition number about 10, in float64.
    torch.testing.assert_close(exact(Source(K, index), x, y), expected, rtol=0, atol=1e-12)


def test_the_smallest_motion_that_is_smooth_closes_the_gap() -> None:
    """A gap of 1e-3 at one end is spread over its neighbours; of a Gaussian source that waypoint alone moves."""
    x, gap = torch.zeros(1, T, D), torch.zeros(1, 2, D)
    gap[:, 0] = 1e-3
    smooth = exact(planner().model.source, x, gap)[0, :, 0]
    assert bool((smooth[:8] > 1e-4).all())
    assert bool((smooth.diff().abs() < 1e-4).all())
    alone = exact(planner("source.kind=gaussian").model.source.condition((0, -1)), x, gap)
    assert torch.equal(alone[:, 0], gap[:, 0])
    assert not bool(alone[:, 1:].any())


def test_feasible_plans_come_first_and_smoother_ones_before_rougher_ones() -> None:
    plans = planner(still=True).plan(torch.tensor([START, GOAL]), torch.tensor([GOAL, START]), 200)
    for pair in (plans[0], plans[1]):
        count = int(pair.feasible.sum())
        assert 20 < count < 180
        assert bool(pair.feasible[:count].all())
        for group in (pair.smoothness[:count], pair.smoothness[count:]):
            assert bool((group.diff() >= 0).all())
        inside = pair.x.abs().flatten(1).amax(dim=1) <= 1
        assert torch.equal(pair.feasible, (pair.clearance >= 0) & inside)
        assert bool((pair.clearance[~pair.feasible] >= 0).any())  # the source alone leaves the workspace now and then


def test_robots_that_pass_through_each_other_between_two_waypoints_are_not_feasible() -> None:
    """At every waypoint they are apart, on the way they are not."""
    through = torch.tensor([[[-0.6, 0.0, 0.6, 0.0], [-0.2, 0.0, 0.2, 0.0], [0.2, 0.0, -0.2, 0.0]]])
    plans = _ranked(through[None], keep_apart(2, 0.3))
    assert not bool(plans.feasible.any())
    assert plans.clearance.item() == pytest.approx(-0.3)


def test_clearance_and_smoothness_are_those_of_the_trajectories_returned() -> None:
    discs = [(0.0, 0.5, 0.1), (0.3, -0.4, 0.05)]
    plans = planner(still=True).plan(START, GOAL, 20, [Obstacle(*discs[0]), discs[1]])
    for x, c, rough in zip(plans.x, plans.clearance, plans.smoothness, strict=True):
        # Between two of its moments a gap changes by less than 1e-4.
        assert c.item() == pytest.approx(clearance(x, discs), abs=1e-4)
        bends = [(x[i + 1] - 2 * x[i] + x[i - 1]).view(2, 2).norm(dim=1).mean() for i in range(1, T - 1)]
        assert rough.item() == pytest.approx(float(torch.stack(bends).mean()), rel=1e-5)
    without = planner(still=True).plan(START, GOAL, 20)
    assert without.clearance[0].item() == pytest.approx(clearance(without.x[0], []), abs=1e-4)


def test_the_network_sees_no_more_plans_at_a_time_the_more_are_asked_for() -> None:
    """And whichever piece a plan falls into, it starts and ends where it should."""
    flow, seen = planner("network.sees_ends=true", "sample.steps=1"), list[int]()
    flow.model.v.register_forward_hook(lambda _, inputs, __: seen.append(len(inputs[0])))
    pairs, num = swap(3), PIECE // 2 + 1
    plans = flow.plan(pairs[:, 0], pairs[:, -1], num)
    assert seen == [PIECE, 3 * num - PIECE]
    assert torch.equal(plans.x[:, :, 0], pairs[:, :1].expand(-1, num, -1))
    single = flow.plan(pairs[2, 0], pairs[2, -1], num)
    # Matrix products of other sizes round otherwise, and may exchange plans that are alike.
    torch.testing.assert_close(single.smoothness, plans[2].smoothness, rtol=0, atol=1e-5)


@pytest.mark.parametrize("still", [False, True])
def test_a_pair_gets_the_same_plans_alone_and_in_a_batch(still: bool) -> None:
    pairs, flow = swap(4), planner(still=still)
    batch = flow.plan(pairs[:, 0], pairs[:, -1], 7, [Obstacle()])
    assert batch.clearance.shape == batch.feasible.shape == batch.smoothness.shape == (4, 7)
    for i in range(4):
        single = flow.plan(pairs[i, 0], pairs[i, -1], 7, [Obstacle()])
        assert single.x.shape == (7, T, D)
        # Matrix products of other sizes round otherwise.
        torch.testing.assert_close(single.x, batch[i].x, rtol=0, atol=1e-5)


def test_one_call_of_the_network_serves_all_pairs_at_every_step() -> None:
    flow, batches = planner(), []
    flow.model.v.register_forward_hook(lambda _module, inputs, _output: batches.append(len(inputs[0])))
    flow.plan(swap(3)[:, 0], swap(3)[:, -1], 5, [Obstacle()])
    assert batches == [15] * flow.model.config.sample.steps


def test_positions_may_come_as_lists_arrays_or_tensors() -> None:
    flow = planner()
    forms: list[Callable[[Any], Any]] = [list, np.array, np.single, torch.tensor]
    results = [flow.plan(form(START), form(GOAL), 2).x for form in forms]
    assert all(torch.equal(results[0], x) for x in results)
    numbers: Any = np.int64(2), [], [(np.float32(0.5), START)]  # as NumPy gives them
    assert flow.plan([-1, 0, 1, 0], (1, 0, -1, 0), *numbers).x.shape == (2, T, D)


def test_guidance_moves_plans_away_from_what_it_avoids_and_in_proportion_to_its_weight() -> None:
    flow, discs = planner(still=True), [(0.0, 0.5, 0.1), (0.0, -0.5, 0.1)]

    def plan(**how: Any) -> Plans:
        return flow.plan(START, GOAL, 60, **how)

    robots = [plan(guidance="robot", robot_weight=weight).clearance.mean() for weight in (0, None, 3)]
    assert robots[0] < robots[1] < robots[2]
    obstacles = [
        plan(guidance="obstacle", obstacles=discs, obstacle_weight=weight).clearance.mean() for weight in (0, 1, 3)
    ]
    assert obstacles[0] < obstacles[1] < obstacles[2]
    assert flow.model.config.sample.obstacle_weight == 1
    both = plan(guidance="all", obstacles=discs, robot_weight=3, obstacle_weight=3)
    assert both.clearance.mean() > obstacles[2]


def test_guidance_around_obstacles_keeps_the_margin_of_training_and_judges_without() -> None:
    """A barrier that is 0 where feasible leaves the wider berth to the margin alone."""
    discs = [(0.0, 0.5, 0.1)]
    clearances = []
    for margin in (0.0, 0.2):
        still = planner("constraint.barrier=relu", f"correction.margin={margin}", still=True)
        plans = still.plan(START, GOAL, guidance="obstacle", obstacles=discs, obstacle_weight=1)
        clearances.append(plans.clearance.mean())
        assert plans.clearance[0] == pytest.approx(clearance(plans.x[0], discs), abs=1e-4)
    assert clearances[0] < clearances[1]


def test_guidance_is_around_robots_always_and_around_obstacles_where_there_are_some() -> None:
    flow = planner(still=True)
    assert torch.equal(flow.plan(START, GOAL, 9).x, flow.plan(START, GOAL, 9, guidance="robot").x)
    default = flow.plan(START, GOAL, 9, [Obstacle()])
    assert torch.equal(default.x, flow.plan(START, GOAL, 9, [Obstacle()], guidance="all").x)
    parts: tuple[Any, ...] = ("robot", "obstacle")
    assert all(not torch.equal(default.x, flow.plan(START, GOAL, 9, [Obstacle()], guidance=part).x) for part in parts)
    unguided = flow.plan(START, GOAL, 9, [Obstacle()], guidance="none")
    assert torch.equal(unguided.x, flow.plan(START, GOAL, 9, [Obstacle()], guidance=None).x)
    switched_off = flow.plan(START, GOAL, 9, [Obstacle()], robot_weight=0, obstacle_weight=0)
    assert torch.equal(unguided.x, switched_off.x)


def test_plans_are_a_function_of_the_request_and_the_seed() -> None:
    flow = planner()
    torch.manual_seed(1)
    first = flow.plan(START, GOAL, 8, [DISC], VIA)
    torch.manual_seed(2)
    again = flow.plan(START, GOAL, 8, [DISC], VIA, seed=0)
    assert torch.equal(first.x, again.x)
    assert torch.equal(first.clearance, again.clearance)
    assert not torch.equal(first.x, flow.plan(START, GOAL, 8, [DISC], VIA, seed=1).x)


METRES, ZERO = 10.0, (3.0, -2.0, 3.0, -2.0)


def in_metres(x: Any) -> Tensor:
    return METRES * torch.as_tensor(x, dtype=torch.float32) + torch.tensor(ZERO)


def planner_in_metres(*arguments: str, still: bool = False) -> Planner:
    """The same model as that of `planner`, of a task whose user counts in metres from elsewhere."""
    model = planner(*arguments, still=still).model
    model.task.scale, model.task.offset = METRES, ZERO
    return Planner(model)


@pytest.mark.parametrize("still", [False, True])
def test_plans_in_the_users_units_are_those_of_the_workspace_brought_there(still: bool) -> None:
    """Obstacles and via-points included; lengths are longer by the scale, and what is feasible stays so."""
    pairs = swap(3)
    starts, goals = pairs[:, 0], pairs[:, -1]
    discs: list[Any] = [Obstacle(0.0, 0.5, 0.1), (0.55, -0.6, 0.05)]
    via: Any = [(0.5, (0.4, 0.6, -0.1, -0.6)), VIA[1]]
    expected = planner(still=still).plan(starts, goals, 20, discs, via)
    via = [(s, in_metres(position)) for s, position in via]
    found = planner_in_metres(still=still).plan(
        in_metres(starts), in_metres(goals), 20, [Obstacle(3.0, 3.0, 1.0), (8.5, -8.0, 0.5)], via
    )
    # Float32 on the way there and back, in metres.
    torch.testing.assert_close(found.x, in_metres(expected.x), rtol=0, atol=1e-4)
    torch.testing.assert_close(found.clearance, METRES * expected.clearance, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.smoothness, METRES * expected.smoothness, rtol=0, atol=1e-4)
    assert torch.equal(found.feasible, expected.feasible)


def test_what_is_asked_for_in_the_users_units_is_met_to_the_last_bit() -> None:
    pairs = swap(3)
    starts, goals = in_metres(pairs[:, 0]), in_metres(pairs[:, -1])
    middle = in_metres(VIA[0][1])
    x = planner_in_metres().plan(starts, goals, 5, via=[(0.5, middle)]).x
    assert torch.equal(x[:, :, 0], starts[:, None].expand(-1, 5, -1))
    assert torch.equal(x[:, :, -1], goals[:, None].expand(-1, 5, -1))
    assert torch.equal(x[:, :, 16], middle.expand(3, 5, -1))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"start": (-7.5, -2, 11, -2)},
            r"start=\(-7.5, -2, 11, -2\): expected finite numbers in the workspace "
            r"\(-7, -12, -7, -12\) to \(13, 8, 13, 8\)$",
        ),
        ({"start": (3, -2, 5, -2)}, r"start=\(3, -2, 5, -2\): violates robot by 1 between robots 1 and 2, expected"),
        ({"goal": (11, -2, -5, -2.1)}, None),
        ({"obstacles": [(-5.0, -1.0, 1.0)]}, r"start=\(-5, -2, 11, -2\): violates obstacles\[0\] by 1.5 at robot 1,"),
        ({"obstacles": [(-5.0, 0.6, 1.0)]}, None),
        ({"via": [(0.5, (3, -2, 3, 9))]}, r"via\[0\]=\(3, -2, 3, 9\): expected finite numbers in the workspace \(-7"),
    ],
)
def test_messages_are_in_the_users_units(changed: dict[str, Any], said: str | None) -> None:
    request: dict[str, Any] = {"start": in_metres(START), "goal": in_metres(GOAL), "num": 2} | changed
    if said is None:
        assert planner_in_metres(still=True).plan(**request).x.shape == (2, T, D)
        return
    with pytest.raises(PlanError, match=said):
        planner_in_metres(still=True).plan(**request)


def test_plans_far_from_the_users_origin_are_those_near_it() -> None:
    """In the metres of a map's projection, of which float32 has every half one: plans had steps, and collided."""
    start, goal = torch.tensor([[-8.3, 0, 8, 0], [8, 0, -8, 0.1]], dtype=torch.float64)
    near, far = (DescentPlanner.of("swap") for _ in range(2))
    plans = []
    for flow, offset in ((near, [0.0] * 4), (far, [5e5, 5.5e6] * 2)):
        flow.model.task.scale, flow.model.task.offset = 10.0, offset
        flow = DescentPlanner(flow.model)
        here = torch.tensor(offset, dtype=torch.float64)
        for made in (flow.plan(start + here, goal + here, 8), flow.best_of(start + here, goal + here, 8)):
            plans.append((made, made.x - here))
            assert torch.equal(plans[-1][0].x[0, 0], start.float() if flow.offset[0] == 0 else start + here)
    for (made, x), (same, expected) in zip(plans[2:], plans[:2], strict=True):
        assert made.x.dtype == torch.float64
        torch.testing.assert_close(x, expected, rtol=0, atol=1e-4)  # metres, of float32 in the workspace
        torch.testing.assert_close(made.smoothness, same.smoothness)
        assert torch.equal(made.feasible, same.feasible)


def test_an_obstacle_is_in_the_units_of_bodies() -> None:
    """Which those of configurations need not be."""
    flow = planner()
    flow.length = 100.0
    assert flow._disc("obstacle", (10.0, 0.0, 5.0)) == Obstacle(0.1, 0.0, 0.05)


def test_one_offset_for_all_axes_makes_one_range() -> None:
    model = planner().model
    model.task.scale, model.task.offset = 5.0, 5.0
    assert Planner(model).plan((0, 5, 10, 5), (10, 5, 0, 5), 2).x.shape == (2, T, D)
    with pytest.raises(PlanError, match=r"expected finite numbers in the workspace \[0, 10\]$"):
        Planner(model).plan((0, 5, 10.1, 5), (10, 5, 0, 5), 2)


def test_an_offset_that_goes_with_no_configuration_is_refused_in_one_line() -> None:
    model = planner().model
    model.task.offset = (3.0, -2.0)
    with pytest.raises(PlanError, match=r"task swap: offset=\(3.0, -2.0\): expected a number, or 4, one for each"):
        Planner(model)


class Post(Task):
    """One robot and a post, in metres."""

    T, scale = 16, METRES
    offset: float | Sequence[float] = (3.0, -2.0)
    robots: Robots = Discs(1, 0.05)

    def constraints(self) -> dict[str, Constraint]:
        return {"post": ObstacleAvoidance(self.robots, [Obstacle(0.0, 0.2, 0.1)])}

    def obstacles(self) -> list[tuple[float, float, float]]:
        return [(0.0, 0.2, 0.1)]

    def demonstrations(self, num: int, seed: int) -> Tensor:
        raise NotImplementedError


def planner_of(task: Task) -> Planner:
    torch.manual_seed(0)
    model = ConFlow(config.load(["preset=smoke"]), task)
    torch.nn.init.zeros_(model.v.outlet.weight)
    torch.nn.init.zeros_(model.v.outlet.bias)
    return Planner(model)


def test_a_single_robot_plans_around_what_its_task_keeps() -> None:
    """And is named by nothing but its constraint: there is no other."""
    flow = planner_of(Post())
    unguided, guided = (flow.plan((-6, -2), (12, -2), 100, guidance=name, robot_weight=3) for name in ("none", "post"))
    assert guided.x.shape == (100, 16, 2)
    assert guided.clearance.mean() > unguided.clearance.mean()
    assert torch.equal(guided.x, flow.plan((-6, -2), (12, -2), 100, robot_weight=3).x)
    x, tau = unguided.x, torch.linspace(0, 1, 200)[:, None]
    between = torch.lerp(x[:, :-1, None], x[:, 1:, None], tau).flatten(1, 2)
    gap = (between - torch.tensor([3.0, 0.0])).norm(dim=2).amin(dim=1) - 1.5
    torch.testing.assert_close(unguided.clearance, gap, rtol=0, atol=1e-3)  # metres, at 200 moments a step
    with pytest.raises(PlanError, match=r"start=\(3, -1\): violates post by 0.5, expected not to$"):
        flow.plan((3, -1), (12, -2))
    with pytest.raises(PlanError, match=r"guidance=robot: expected one of none, all, post, obstacle$"):
        flow.plan((-6, -2), (12, -2), guidance="robot")


class Trio(Task):
    """Three robots of which each is larger than the one before."""

    T = 16
    robots: Robots = Discs(3, (0.05, 0.1, 0.2))

    def constraints(self) -> dict[str, Constraint]:
        return {"robot": RobotAvoidance(self.robots)}

    def demonstrations(self, num: int, seed: int) -> Tensor:
        raise NotImplementedError


TRIO = (-0.8, 0, 0.8, 0, 0, 0.8), (0.8, 0, -0.8, 0, 0, -0.8)


def test_of_three_robots_those_that_collide_are_named() -> None:
    """In a batch, those of the first pair that is refused, though another is worse."""
    flow = planner_of(Trio())
    assert flow.plan(*TRIO, 3).x.shape == (3, 16, 6)
    starts = [TRIO[0], (-0.8, 0, 0.8, 0, 0.8, 0.2), (0, 0, 0, 0.01, 0, 0.8), (0.3, 0, -0.3, 0, 0.4, 0)]
    for start, said in zip(
        starts[1:],
        (
            r"violates robot by 0.1 between robots 2 and 3",
            r"by 0.14 between robots 1 and 2",
            r"by 0.15 between robots 1 and 3",
        ),
        strict=True,
    ):
        with pytest.raises(PlanError, match=said):
            flow.plan(start, TRIO[1], 3)
    with pytest.raises(
        PlanError, match=r"start\[1\]=\(-0.8, 0, 0.8, 0, 0.8, 0.2\): violates robot by 0.1 between .* 3,"
    ):
        flow.plan(starts, [TRIO[1]] * 4, 3)


class InSpace(Trio):
    robots = Balls(2, 0.05)


def test_discs_are_no_obstacles_of_robots_in_space() -> None:
    """Which plan all the same without them."""
    ends = (-0.8, 0, 0, 0.8, 0, 0), (0.8, 0, 0, -0.8, 0, 0)
    flow = planner_of(InSpace())
    assert flow.plan(*ends, 3).x.shape == (3, 16, 6)
    with pytest.raises(PlanError, match=r"^obstacles for bodies in 3 dimensions: expected bodies in the plane"):
        flow.plan(*ends, 3, obstacles=[(0, 0.5, 0.1)])


def test_a_refusal_names_the_robots_whatever_the_barrier_counts() -> None:
    with pytest.raises(PlanError, match=r"violates robot by 0.1 between robots 1 and 2"):
        planner("constraint.pairs=all").plan((0, 0, 0.2, 0), GOAL)


class Passing(Constraint):
    """A disc that passes through the workspace, and so is elsewhere at every waypoint."""

    def clearance(self, x: Tensor) -> Tensor:
        place = torch.stack([torch.linspace(-0.8, 0.8, 16), torch.zeros(16)], dim=1)
        return (self.robots.points(x)[:, :, 0] - place).norm(dim=2) - 0.2

    def swept_clearance(self, x: Tensor) -> Tensor:
        c = self.clearance(x)
        return torch.minimum(c[:, :-1], c[:, 1:])


class Hurry(Constraint):
    """The robot never stands still."""

    def clearance(self, x: Tensor) -> Tensor:
        c = x.diff(dim=1).norm(dim=2) - 0.01
        return torch.cat([c[:, :1], c], dim=1)

    def swept_clearance(self, x: Tensor) -> Tensor:
        return self.clearance(x)[:, 1:]


class Crossing(Post):
    scale, offset = 1.0, 0.0

    def constraints(self) -> dict[str, Constraint]:
        return {"passing": Passing(self.robots), "hurry": Hurry(self.robots)}


def test_what_is_asked_for_is_judged_at_its_own_waypoint_and_not_as_if_the_robot_stood_there() -> None:
    """Where the disc will be later is free now, and who starts somewhere does not stay there."""
    flow = planner_of(Crossing())
    assert flow.plan((0.8, 0), (-0.8, 0), 2, via=[(0.1, (0.5, 0.0))]).x.shape == (2, 16, 2)
    for start, goal, via, said in (
        ((-0.7, 0), (-0.8, 0), [], r"start=\(-0.7, 0\): violates passing by 0.1, expected"),
        ((0.8, 0), (0.8, 0), [], r"goal=\(0.8, 0\): violates passing by 0.2"),
        ((0.8, 0), (-0.8, 0), [(0.8, (0.48, 0.0))], r"via\[0\]=\(0.48, 0\): violates passing by 0.2"),
    ):
        with pytest.raises(PlanError, match=said):
            flow.plan(start, goal, 2, via=via)


class Named(Post):
    def constraints(self) -> dict[str, Constraint]:
        return {"obstacle": super().constraints()["post"]}


def test_a_constraint_may_be_called_as_the_obstacles_are() -> None:
    """Then that name guides around both."""
    flow = planner_of(Named())
    plans = flow.plan((-6, -2), (12, -2), 9, guidance="obstacle")
    assert torch.equal(plans.x, flow.plan((-6, -2), (12, -2), 9).x)
    with pytest.raises(PlanError, match=r"guidance=post: expected one of none, all, obstacle$"):
        flow.plan((-6, -2), (12, -2), 9, guidance="post")


def circles(planner: Planner, plans: Plans, obstacles: list[tuple[float, float, float]]) -> list[tuple[float, ...]]:
    """The discs that a picture of plans shows, (x, y, radius)."""
    (axis,) = picture(planner, plans, obstacles).axes
    shown = [patch for patch in axis.patches if isinstance(patch, Circle)]
    return [(*map(float, circle.center), float(circle.radius)) for circle in shown]


@pytest.mark.parametrize("robots", [1, 2, 3, 4, 6, 7])
def test_the_legend_of_plans_names_every_robot_of_a_few_inside_the_picture(robots: int) -> None:
    """Of more the best plan alone is drawn, a path for each."""
    ends: tuple[Any, Any] = (-6.0, -2.0), (12.0, -2.0)
    if robots == 1:
        flow = planner_of(Post())
    else:
        flow = Planner(model_of(config.load(["preset=smoke"]), T, 2 * robots))
        angles = 2 * math.pi * torch.arange(robots) / robots
        start = 0.9 * torch.stack([angles.cos(), angles.sin()], dim=1).flatten()
        ends = start, -start
    figure = picture(flow, flow.plan(*ends, 4))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    named = range(robots) if robots <= NAMED else ()
    assert sorted(texts) == sorted([*(f"robot {i + 1}" for i in named), "not feasible", "goal"])
    others = [one for one in figure.axes[0].collections if isinstance(one, LineCollection)]
    assert len(others) == 2 * len(named)
    for part in (legend, *legend.get_texts(), *figure.axes):
        box = part.get_tightbbox(canvas.renderer)
        assert box is not None
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
    assert not legend.get_window_extent().overlaps(figure.axes[0].get_window_extent())


def test_the_picture_of_plans_is_in_the_users_units() -> None:
    flow = planner_in_metres(still=True)
    plans = flow.plan(in_metres(START), in_metres(GOAL), 5)
    (axis,) = picture(flow, plans, [(3.0, 3.0, 1.0)]).axes
    assert axis.get_xlim() == pytest.approx((-7.5, 13.5))
    assert axis.get_ylim() == pytest.approx((-12.5, 8.5))
    best = [line.get_xydata() for line in axis.lines if line.get_linewidth() == 2.5]
    for robot, path in enumerate(best):
        assert np.asarray(path) == pytest.approx(plans.x[0, :, 2 * robot : 2 * robot + 2].numpy(), abs=1e-5)
    assert circles(flow, plans, [(3.0, 3.0, 1.0)]) == [(3.0, 3.0, 1.0)], "the task's is not there when plans are made"


def test_what_a_task_always_has_in_the_way_is_in_the_picture() -> None:
    flow = planner_of(Post())
    found = circles(flow, flow.plan((-6, -2), (12, -2), 2), [(6.0, -6.0, 0.5)])
    assert [pytest.approx(disc) for disc in found] == [(6.0, -6.0, 0.5), (3.0, 0.0, 1.0)]


class Pendulum(Robots):
    """A joint with two bodies on its rod; a configuration is half its angle, and no position."""

    D, radii, owner = 1, torch.tensor([0.05, 0.05], dtype=torch.float64), torch.tensor([0, 0])

    def points(self, x: Tensor) -> Tensor:
        direction = torch.stack([(2 * x[..., 0]).sin(), -(2 * x[..., 0]).cos()], dim=-1)
        return torch.stack([direction / 3, 2 * direction / 3], dim=2)

    def pullback(self, x: Tensor, g: Tensor) -> Tensor:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            return torch.autograd.grad(self.points(x), x, g)[0]


class Swing(Post):
    scale, offset = 2.0, 0.0
    robots = Pendulum()

    def constraints(self) -> dict[str, Constraint]:
        return {"post": ObstacleAvoidance(self.robots, [Obstacle(0.6, 0.6, 0.1)])}


def test_the_picture_of_plans_shows_bodies_where_configurations_put_them() -> None:
    flow = planner_of(Swing())
    plans = flow.plan((-1.0,), (1.0,), 3)
    assert plans.x.shape == (3, 16, 1)
    (axis,) = picture(flow, plans).axes
    best = [np.asarray(line.get_xydata()) for line in axis.lines if line.get_linewidth() == 2.5]
    angle = plans.x[0, :, 0].numpy()
    for path, length in zip(best, (2 / 3, 4 / 3), strict=True):
        assert path == pytest.approx(length * np.stack([np.sin(angle), -np.cos(angle)], axis=1), abs=1e-5)


NAN, INF = float("nan"), float("inf")
REQUEST: dict[str, Any] = {"start": START, "goal": GOAL, "num": 2}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"start": (-1.2, 0, 0.8, 0)}, r"start=\(-1.2, 0, 0.8, 0\): expected finite .* workspace \[-1, 1\]"),
        ({"goal": (0.8, 0, NAN, 0)}, r"goal=\(0.8, 0, nan, 0\): expected finite"),
        ({"goal": (0.8, 0, -INF, 0)}, r"goal=.*-inf.*expected finite"),
        ({"start": (0, 0, 0.2, 0)}, r"start=\(0, 0, 0.2, 0\): violates robot by 0.1 between robots 1 and 2"),
        ({"goal": (0.5, 0.5, 0.5, 0.5)}, r"goal=.*violates robot by 0.3"),
        ({"start": (0.8, 0)}, r"start=\(0.8, 0\): found shape \(2,\), expected numbers of shape \(4,\) or \(B, 4\)"),
        ({"start": 0.8}, r"start=0.8: found shape \(\), expected"),
        ({"start": np.zeros((1, 1, 4))}, r"start=.*found shape \(1, 1, 4\)"),
        ({"start": np.zeros((0, 4)), "goal": np.zeros((0, 4))}, r"start=\[\]: found shape \(0, 4\)"),
        ({"start": ("a", "b", "c", "d")}, r"start=\('a'.*expected numbers"),
        ({"start": [[0.8, 0], [0.1]]}, r"start=\[\[0.8.*expected numbers"),
        ({"start": None}, r"start=None: expected numbers"),
        ({"start": (True, False, True, False)}, r"start=.*found torch.bool"),
        ({"goal": np.array(GOAL) * 1j}, r"goal=.*found torch.complex"),
        ({"start": [START, START]}, r"goal: found shape \(4,\), expected that of start, \(2, 4\)"),
        ({"start": [START] * 3, "goal": [GOAL] * 2}, r"goal: found shape \(2, 4\), expected .* \(3, 4\)"),
        ({"start": [START, (0, 0, 0, 2)], "goal": [GOAL] * 2}, r"start\[1\]=\(0, 0, 0, 2\): expected finite"),
        ({"start": [START] * 2, "goal": [GOAL, (0, 0, 0, 0)]}, r"goal\[1\]=\(0, 0, 0, 0\): violates robot by 0.3"),
        ({"num": 0}, r"num=0: expected a whole number of at least 1"),
        ({"num": 2.0}, r"num=2.0: expected a whole number"),
        ({"num": True}, r"num=True: expected a whole number"),
        ({"seed": 0.5}, r"seed=0.5: expected a whole number of at least 0"),
        ({"obstacles": [(-0.8, 0.1, 0.1)]}, r"start=.*violates obstacles\[0\] by 0.15 at robot 1"),
        ({"obstacles": [Obstacle(), Obstacle(0.8, 0.2, 0.1)]}, r"start=.*violates obstacles\[1\] by 0.05 at robot 2"),
        ({"obstacles": [(0.4, 0.5, 0)]}, r"obstacles\[0\]=\(0.4, 0.5, 0\): .* radius above 0"),
        ({"obstacles": [(0.4, 0.5, -0.1)]}, r"obstacles\[0\]=.* radius above 0"),
        ({"obstacles": [Obstacle(), Obstacle(0, 0, NAN)]}, r"obstacles\[1\]=\(0, 0, nan\): expected finite"),
        ({"obstacles": [(0.4, INF, 0.1)]}, r"obstacles\[0\]=.*expected finite"),
        ({"obstacles": [(0.4, 0.1)]}, r"obstacles\[0\]=\(0.4, 0.1\): found shape \(2,\), expected an Obstacle or"),
        ({"obstacles": (0.4, 0.5, 0.1)}, r"obstacles\[0\]=0.4: found shape \(\), expected an Obstacle or"),
        ({"obstacles": Obstacle()}, r"obstacles=Obstacle.*expected a sequence"),
        ({"via": [(0, START)]}, r"via\[0\]: s=0, expected a number above 0 and below 1"),
        ({"via": [(1.0, GOAL)]}, r"via\[0\]: s=1.0, expected"),
        ({"via": [(NAN, GOAL)]}, r"via\[0\]: s=nan, expected"),
        ({"via": [("0.5", GOAL)]}, r"via\[0\]: s=0.5, expected a number"),
        ({"via": [(0.5, (0, 0, 0, 0.5)), (0.51, START)]}, r"via\[1\]: s=0.51 falls on waypoint 16 of 32 as via\[0\]"),
        ({"via": [(0.5, (0, 0, 0, 1.5))]}, r"via\[0\]=\(0, 0, 0, 1.5\): expected finite"),
        ({"via": [(0.5, [START])]}, r"via\[0\]=.*found shape \(1, 4\), expected numbers of shape \(4,\)$"),
        ({"via": [(0.5, (0, 0, 0, 0.1))]}, r"via\[0\]=\(0, 0, 0, 0.1\): violates robot by 0.2 between robots 1 and 2"),
        ({"via": [(0.3, (0, 0, 0, 0.5))], "obstacles": [Obstacle()]}, r"via\[0\]=.*violates obstacles\[0\] by 0.25"),
        ({"via": [0.5]}, r"via\[0\]=0.5: expected \(s, position\)"),
        ({"via": 0.5}, r"via=0.5: expected a sequence"),
        ({"guidance": "robots"}, r"guidance=robots: expected one of none, all, robot, obstacle; did you mean robot\?"),
        ({"guidance": 0.08}, r"guidance=0.08: expected one of"),
        ({"guidance": "obstacle"}, r"guidance=obstacle: expected obstacles to guide around, found none"),
        ({"robot_weight": -1}, r"robot_weight=-1: expected a finite number of at least 0"),
        ({"obstacle_weight": INF}, r"obstacle_weight=inf: expected a finite number of at least 0"),
    ],
)
def test_a_bad_request_is_refused_in_one_line(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(PlanError, match=said) as refused:
        planner(still=True).plan(**REQUEST | changed)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("kind", SOURCES)
def test_a_checkpoint_plans_as_the_model_that_was_saved(kind: str, tmp_path: Path) -> None:
    flow = planner(f"source.kind={kind}", "source.length_scale=0.3")
    path = save(flow.model, tmp_path / "model.ckpt")
    expected = flow.plan(START, GOAL, 4, [DISC], VIA).x
    for given in (path, str(path)):
        assert torch.equal(Planner.load(given).plan(START, GOAL, 4, [DISC], VIA).x, expected)


def test_a_run_of_a_named_task_takes_no_other(tmp_path: Path) -> None:
    """As where several runs are drawn, of which some are of a task of one's own: that task is left as it is."""
    flow, other = planner(), Trio()
    loaded = Planner.load(save(flow.model, tmp_path / "model.ckpt"), other)
    assert loaded.model.task.name == "swap"
    assert torch.equal(loaded.plan(START, GOAL, 3).x, flow.plan(START, GOAL, 3).x)
    assert "scale" not in vars(other)


def test_another_task_than_the_runs_is_refused_in_one_line(tmp_path: Path) -> None:
    """The file is whole, so it is not called damaged; and the task stays as it was."""
    model = ConFlow(config.load(["preset=smoke", "task=post.py"]), Post())
    path = save(model, tmp_path / "model.ckpt")
    assert Planner.load(path, Post()).model.task.name == "post"
    other = Trio()
    with pytest.raises(PlanError) as refused:
        Planner.load(path, other)
    found, expected = "found T=16 waypoints of D=6 numbers", "expected T=16 and D=2, as the run of task post has"
    assert str(refused.value) == f"run={path}: task=trio: {found}, {expected}"
    assert "scale" not in vars(other)
    longer = Post()
    longer.T = 20
    with pytest.raises(ConfigError, match=r"^task=post: found T=20 waypoints of D=2 numbers, expected T=16 and D=2"):
        load_model(path, task=longer)


@pytest.mark.parametrize("error", [ZeroDivisionError, FileNotFoundError("map.npy")])
def test_an_error_of_a_task_of_ones_own_is_not_called_a_damaged_file(error: Any, tmp_path: Path) -> None:
    class Broken(Post):
        def constraints(self) -> dict[str, Constraint]:
            raise error

    path = save(ConFlow(config.load(["preset=smoke", "task=post.py"]), Post()), tmp_path / "model.ckpt")
    with pytest.raises(error if isinstance(error, type) else type(error)):
        Planner.load(path, Broken())


def test_a_setting_that_a_task_no_longer_takes_is_named(tmp_path: Path) -> None:
    model = ConFlow(config.load(["preset=smoke", "task=post.py", "task.height=2"]), Post())
    path = save(model, tmp_path / "model.ckpt")
    with pytest.raises(PlanError) as refused:
        Planner.load(path, Post())
    assert str(refused.value) == f"run={path}: task.height=2: no such setting of task post, it takes none"


def test_a_fitted_source_is_conditioned_on_via_points_with_its_own_kernel(tmp_path: Path) -> None:
    model = model_of(fitted(config.load(["preset=smoke", "source.fit=true"]), swap(100)), T, D)
    loaded = Planner.load(save(model, tmp_path / "model.ckpt"))
    assert not torch.equal(loaded.model.source.prior, rbf(T, 0.4, 1.0, 1e-6))
    assert torch.equal(
        loaded.plan(START, GOAL, 4, via=VIA, seed=2).x, Planner(model).plan(START, GOAL, 4, via=VIA, seed=2).x
    )


class Trap:
    """An object whose unpickling leaves a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


def test_a_file_that_is_no_checkpoint_is_refused_in_one_line_and_never_executed(tmp_path: Path) -> None:
    whole = save(planner().model, tmp_path / "whole.ckpt").read_bytes()
    contents = {
        "truncated": whole[: len(whole) // 2],
        "empty": b"",
        "text": b"not a checkpoint",
        "pickle": pickle.dumps(Trap(tmp_path / "sprung")),
    }
    for name, content in contents.items():
        (tmp_path / f"{name}.ckpt").write_bytes(content)
    torch.save({"conflow": Trap(tmp_path / "sprung")}, tmp_path / "trap.ckpt")
    torch.save({"state_dict": {}}, tmp_path / "foreign.ckpt")
    torch.save([1, 2], tmp_path / "list.ckpt")
    described = {"config": planner().model.config.tree(), "T": T, "D": D, "scale": 1.0, "offset": 0.0}
    torch.save({"conflow": described, "state_dict": {}}, tmp_path / "weightless.ckpt")
    (tmp_path / "folder.ckpt").mkdir()
    for name in (*contents, "trap", "foreign", "list", "weightless", "folder"):
        with pytest.raises(PlanError) as refused:
            Planner.load(tmp_path / f"{name}.ckpt")
        assert str(refused.value) == (
            f"run={tmp_path / name}.ckpt: expected the model.ckpt of a run of this version, "
            "found a damaged or foreign file"
        )
    assert not (tmp_path / "sprung").exists()
    with pytest.raises(PlanError, match=r"run=.*none.ckpt: no such file, expected the model.ckpt of a run"):
        Planner.load(tmp_path / "none.ckpt")


def test_a_run_is_found_by_whatever_names_it_or_by_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    monkeypatch.chdir(tmp_path)
    flow = planner()
    client = store.client()
    experiment = client.get_experiment_by_name(store.EXPERIMENT)
    assert experiment is not None
    ids = [client.create_run(experiment.experiment_id, run_name=name).info.run_id for name in ("empty-s0", "cgp-s0")]
    client.log_artifact(ids[1], str(save(flow.model, tmp_path / "model.ckpt")))
    for run_id in ids:
        client.set_terminated(run_id)
    client.set_tag(ids[1], "preset", "long")
    (tmp_path / "models").mkdir()
    save(flow.model, tmp_path / "models" / "mine")
    for wanted in ("cgp-s0", ids[1], "latest", "long/cgp-s0", "models/mine"):
        assert torch.equal(Planner.load(wanted).plan(START, GOAL, 3).x, flow.plan(START, GOAL, 3).x)
    with pytest.raises(PlanError, match=r"run=cpg-s0: no such finished run.*did you mean cgp-s0\?"):
        Planner.load("cpg-s0")
    with pytest.raises(PlanError, match=r"run=lnog/cgp-s0: no such finished run.*did you mean long/cgp-s0\?"):
        Planner.load("lnog/cgp-s0")
    with pytest.raises(PlanError, match=r"run=empty-s0: .*model.ckpt"):
        Planner.load("empty-s0")


@pytest.fixture
def conflow_sample(in_process: Typed, tmp_path: Path) -> Typed:
    """`python -m conflow sample ...` in a folder with a model.ckpt."""
    save(planner(still=True).model, tmp_path / "model.ckpt")
    return partial(in_process, "sample", "run=./model.ckpt")


PAIR = ("start=-0.8,0,0.8,0", "goal=0.8,0,-0.8,0")


def test_the_command_writes_plans_and_picture_and_says_how_many_are_feasible(
    conflow_sample: Typed, tmp_path: Path
) -> None:
    discs = ("obstacle=0,0.5,0.1", "obstacle=0.3,-0.4,0.05")
    code, out, err = conflow_sample(*PAIR, "out=plans.npz", "num=40", *discs, "guidance=robot", "seed=3")
    assert (code, err) == (0, "")
    expected = Planner.load(tmp_path / "model.ckpt").plan(
        START, GOAL, 40, [(0, 0.5, 0.1), (0.3, -0.4, 0.05)], guidance="robot", seed=3
    )
    with np.load("plans.npz") as file:
        assert set(file) == {"x", "clearance", "feasible", "smoothness", "start", "goal"}
        for name in ("x", "clearance", "feasible", "smoothness"):
            assert np.array_equal(file[name], getattr(expected, name).numpy())
        assert np.array_equal(file["start"], np.array(START, np.float32))
        assert np.array_equal(file["goal"], file["x"][0, -1])
    assert Path("plans.png").read_bytes().startswith(b"\x89PNG")
    count = int(expected.feasible.sum())
    # Wilson's interval, written out.
    p, n, z = count / 40, 40, 1.959964
    low, high = ((p + z**2 / 80 + s * z * math.sqrt(p * (1 - p) / n + z**2 / 6400)) / (1 + z**2 / n) for s in (-1, 1))
    assert out == (
        f"Run smoke/cgp-s0: {count} of 40 plans are feasible, {p:.1%} (95 % interval {low:.1%} to {high:.1%}); "
        f"best clearance {expected.clearance.max():.3f}\nWritten: plans.npz and plans.png\n"
    )


def test_the_command_takes_points_to_pass(conflow_sample: Typed, tmp_path: Path) -> None:
    code, out, err = conflow_sample(*PAIR, "num=9", "via=0.5,0.1,0.6,-0.1,-0.6", "via=0.26,-0.3,0.37,0.41,-0.32")
    assert (code, err) == (0, "")
    assert "of 9 plans are feasible" in out
    expected = Planner.load(tmp_path / "model.ckpt").plan(START, GOAL, 9, via=VIA)
    with np.load("plans.npz") as file:
        assert np.array_equal(file["x"], expected.x.numpy())
        assert np.array_equal(file["x"][:, 16], np.tile(np.array(VIA[0][1], np.float32), (9, 1)))


@pytest.mark.parametrize("existing", ["plans.npz", "plans.png"])
def test_the_command_never_overwrites(existing: str, conflow_sample: Typed) -> None:
    Path(existing).write_text("precious")
    code, out, err = conflow_sample(*PAIR)
    assert (code, out) == (2, "")
    assert err == f"conflow: out=plans.npz: expected a new file, found that {existing} exists already\n"
    assert Path(existing).read_text() == "precious"
    assert len(list(Path().glob("plans.*"))) == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), 'start: expected .* found none; try: make sample START="-0.8,0,0.8,0" GOAL="0.8,0,-0.8,0"'),
        (("start=-0.8,0,0.8,0", "goal="), "goal: expected .* found none; try: make sample"),
        ((*PAIR, "obstcle=0,0,1"), r"obstcle: no such option.*did you mean obstacle\?"),
        ((*PAIR, "here"), "here: expected key=value"),
        (("start=-0.8;0", "goal=0,0"), "start=-0.8;0: expected numbers with commas between, such as -0.8,0,0.8,0"),
        (("start=-0.8,0", "goal=0,0"), r"start=\[-0.8, 0.0\]: found shape \(2,\)"),
        ((*PAIR, "obstacle=0,0.5"), r"obstacles\[0\]=\[0.0, 0.5\]: found shape \(2,\), expected .*radius"),
        ((*PAIR, "via=0.5"), r"via\[0\]=\[\]: found shape \(0,\), expected numbers of shape \(4,\)"),
        ((*PAIR, "via=0.5,0,0,0,0.5", "via=1.5,0,0,0,0.5"), r"via\[1\]: s=1.5, expected a number above 0 and below 1"),
        ((*PAIR, "via=half,0,0,0,0.5"), "via=half,0,0,0,0.5: expected numbers with commas between"),
        ((*PAIR, "num=0"), "num=0: expected a whole number of at least 1"),
        ((*PAIR, "seed=-1"), "seed=-1: expected a whole number of at least 0"),
        ((*PAIR, "guidance=robbot"), r"guidance=robbot: expected one of .*did you mean robot\?"),
        ((*PAIR, "out=plans.csv"), "out=plans.csv: expected a name that ends in .npz"),
        ((*PAIR, "out=no/plans.npz"), "out=no/plans.npz: expected an existing folder, found no no"),
        ((*PAIR, "run=./none.ckpt"), "run=./none.ckpt: no such file"),
    ],
)
def test_a_bad_command_ends_in_one_line_and_writes_nothing(
    arguments: tuple[str, ...], said: str, conflow_sample: Typed
) -> None:
    code, out, err = conflow_sample(*arguments)
    assert (code, out) == (2, "")
    assert err.startswith("conflow: ")
    assert err.count("\n") == 1
    assert re.search(said, err)
    assert [path.name for path in Path().iterdir()] == ["model.ckpt"]


def test_a_plan_without_a_model_meets_start_goal_and_via_points_clear_of_all_obstacles() -> None:
    plans = DescentPlanner.of("swap").plan([START, START], [GOAL, GOAL], 16, [DISC], VIA)
    assert plans.feasible.all()
    assert torch.equal(plans.x[0], plans.x[1])
    assert torch.equal(
        plans.x[:, :, [0, 8, 16, -1]], torch.tensor([START, VIA[1][1], VIA[0][1], GOAL]).expand(2, 16, -1, -1)
    )
    assert min(clearance(x, [DISC]) for x in plans.x[0]) >= -1e-6  # of float32
    assert not torch.equal(plans.x[0, 0], plans.x[0, 1])


@pytest.mark.parametrize("task", [Weave(28), Room(9).in_scene(9, 0, 3), Pandas()])
def test_a_plan_without_a_model_is_found_from_each_robots_own_way(task: SceneTask) -> None:
    start, goal = task.scene(task.robots.count, 0, 3)
    flow = DescentPlanner.of(task)
    start, goal = (flow.scale * end + flow.offset for end in (start, goal))
    best = flow.best_of(start, goal, num=8, seconds=60)
    assert best.feasible.tolist() == [True]
    assert torch.equal(best.x[0, [0, -1]], torch.stack([start, goal]))
    # What it started from is the task's own.
    raw = flow.to_workspace(flow.plan(start, goal, 3, descent=0).x)
    ways = task.between(flow.to_workspace(torch.stack([start, goal])).expand(3, -1, -1), random_stream("plan", 0))
    torch.testing.assert_close(raw.sort(dim=0).values, ways.sort(dim=0).values, rtol=0, atol=1e-6)


def test_a_start_on_the_border_of_the_users_workspace_is_planned_from() -> None:
    """In workspace units it may be a bit outside, where no candidate was ever feasible."""
    task = Weave(2)
    task.scale, task.offset = 1.3, 1.1
    flow = DescentPlanner.of(task)
    high, low = (flow.offset + sign * flow.scale for sign in (1, -1))
    start = torch.stack([high[0], torch.tensor(1.4), low[0], torch.tensor(0.8)])
    assert float(flow.to_workspace(start).abs().max()) > 1
    goal = torch.tensor([0.6, 1.4, 2.0, 0.8])
    best = flow.best_of(start, goal, num=8, seconds=20)
    assert best.feasible.tolist() == [True]
    assert torch.equal(best.x[0, [0, -1]], torch.stack([start, goal]))


def test_without_a_model_any_number_of_a_crowd_is_planned_for() -> None:
    start, goal = Weave(6).scene(6, 0, 0)
    flow = DescentPlanner.of("weave")
    best = flow.best_of(start, goal, num=4)
    assert best.x.shape == (1, 64, 12)
    figure = picture(flow, best)  # of six, not of the 28 that the task has by itself
    assert len([line for line in figure.axes[0].lines if len(line.get_xdata()) == 64]) == 6  # type: ignore[arg-type]


def test_without_a_model_a_file_is_refused_and_not_passed_over() -> None:
    with pytest.raises(ConfigError, match=r"^data\.path=mine\.npz: expected none, without a model"):
        DescentPlanner.of("swap", data__path="mine.npz")


def test_without_a_model_there_is_no_flow_to_guide() -> None:
    flow = DescentPlanner.of("swap", correction__margin=0.05)
    assert torch.equal(flow.plan(START, GOAL, 2).x, flow.plan(START, GOAL, 2, guidance="none").x)
    with pytest.raises(PlanError, match="guidance=robot: expected all or none, without a model there is no flow"):
        flow.plan(START, GOAL, 2, guidance="robot")
    with pytest.raises(PlanError, match="robot_weight=3: expected none, without a model there is no flow"):
        flow.plan(START, GOAL, 2, robot_weight=3)
    with pytest.raises(ConfigError, match=r"correction.margn: no such setting.*did you mean"):
        DescentPlanner.of("swap", correction__margn=0.05)


class Line(Post):
    """The same robot, whose straight ways come from NumPy, in other units than the task says."""

    def demonstrations(self, num: int, seed: int) -> Demonstrations:  # type: ignore[override]
        x = np.random.default_rng(seed).uniform(-1, 1, (2, num, 1, 2))
        return Demonstrations(x[0] + np.linspace(0, 1, self.T)[:, None] * (x[1] - x[0]), scale=2.0)


def test_a_task_of_ones_own_is_planned_for_without_a_model_as_it_is_trained() -> None:
    flow = DescentPlanner.of(Line())
    assert flow.scale.tolist() == [2.0, 2.0]
    assert flow.plan((1.5, -2), (4.5, -2), 3).x.shape == (3, 16, 2)


def test_a_task_that_lacks_something_is_refused_without_a_model_too() -> None:
    class Nobody(Post):
        pass

    with pytest.MonkeyPatch.context() as patch:
        patch.delattr(Post, "robots")
        with pytest.raises(ConfigError, match=r"^task=nobody: expected an attribute robots, such as conflow\.Discs"):
            DescentPlanner.of(Nobody())


def test_the_command_plans_without_a_model(in_process: Typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = in_process("sample", "run=none", *PAIR, "num=5")
    assert (code, err) == (0, "")
    assert out.startswith("Task swap, without a model: 5 of 5 plans are feasible, 100.0% (95 % interval")
    with np.load("plans.npz") as file:
        assert np.array_equal(file["x"], DescentPlanner.of("swap").plan(START, GOAL, 5).x.numpy())
