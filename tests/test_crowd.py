"""Crowds: constraints for any number of discs, scenes, demonstrations of single robots, and how they are trained on."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from conflow.errors import ConfigError
from conflow.flow.attention import SpectralAttention
from conflow.flow.source import cgp
from conflow.planner import DescentPlanner, PlanError, Planner
from conflow.scene.constraint import Barrier, Constraint, RobotAvoidance
from conflow.scene.crowd import CrowdAvoidance, MapAvoidance
from conflow.scene.demonstrations import check
from conflow.scene.errors import DemonstrationError
from conflow.scene.robots import Crowd, Discs
from conflow.scene.settings import Box
from conflow.scene.tasks import CROWDS
from conflow.scene.tasks.crowd import ALONG, AMPLITUDES, CrowdTask, singles
from conflow.scene.tasks.weave import JITTER, PHASE
from conflow.training import config
from conflow.training.build import build_task, fitted
from conflow.training.datamodule import Batches, DemonstrationData, Split
from conflow.training.model import ConFlow

crowds = pytest.mark.parametrize("task", sorted(CROWDS))


def trajectories(count: int, num: int = 6, T: int = 9) -> Tensor:
    return 0.6 * torch.randn(num, T, 2 * count, generator=torch.Generator().manual_seed(count), dtype=torch.float64)


@pytest.mark.parametrize("count", [2, 3, 7])
@pytest.mark.parametrize("shape", ["softplus", "relu", "square"])
def test_a_crowd_avoids_itself_as_any_robots_do(count: int, shape: str) -> None:
    """The general constraint is the oracle, of pairs in the same order."""
    x, barrier = trajectories(count), Barrier(shape, gamma=5.0, pairs="all")  # type: ignore[arg-type]
    general = RobotAvoidance(Discs(count, 0.1)).double().shaped(barrier, 0.05)
    ours = CrowdAvoidance(Crowd(11, 0.1)).shaped(barrier, 0.05)
    for name in ("clearance", "clearances", "swept_clearance", "barrier", "gradient"):
        # The general one holds its radii in single precision.
        torch.testing.assert_close(getattr(ours, name)(x), getattr(general, name)(x), rtol=1e-6, atol=1e-6)


def test_a_gradient_in_pieces_is_that_of_each_trajectory() -> None:
    x = trajectories(14, num=150)  # 91 pairs: three pieces, the last one smaller
    ours = CrowdAvoidance(Crowd(14, 0.1)).shaped(Barrier(pairs="all"))
    torch.testing.assert_close(ours.gradient(x), torch.cat([ours.gradient(one) for one in x.split(1)]))
    assert ours.gradient(x[:0]).shape == (0, 9, 28)


def test_barrier_and_gradient_are_those_that_are_computed_apart() -> None:
    x = trajectories(4)
    walls_too = CrowdAvoidance(Crowd(4, 0.1)).shaped(Barrier(pairs="all"))
    C, g = walls_too.barrier_and_gradient(x)
    assert torch.equal(C, walls_too.barrier(x))
    assert torch.equal(g, walls_too.gradient(x))


BOXES = [Box(0.0, 0.0, 0.8, 0.3, rounding=0.05), Box(-0.5, 0.6, 0.25, 0.25, rounding=0.0)]


def test_the_distance_to_a_rounded_box_is_that_to_its_nearest_point() -> None:
    """The box is drawn as its core, blown up by the rounding: the oracle looks at many points of the core."""
    draw = torch.Generator().manual_seed(0)
    x = 2 * torch.rand(200, 1, 2, generator=draw, dtype=torch.float64) - 1
    c = MapAvoidance(Crowd(1, 0.05), BOXES).clearances(x)[:, 0]
    for k, box in enumerate(BOXES):
        core = torch.tensor([box.width, box.height]) / 2 - box.rounding
        u, v = torch.meshgrid(torch.linspace(-1, 1, 801), torch.linspace(-1, 1, 801), indexing="ij")
        filled = torch.stack([box.x + core[0] * u, box.y + core[1] * v], dim=-1).flatten(0, 1).double()
        distance = torch.cdist(x[:, 0], filled).amin(dim=1)
        outside = distance > 2e-3
        torch.testing.assert_close(c[outside, k], distance[outside] - box.rounding - 0.05, rtol=0, atol=2e-3)
        assert (c[~outside, k] < 0).all()


def test_the_gradient_of_a_map_is_that_of_automatic_differentiation() -> None:
    x = trajectories(3, num=40)
    ours = MapAvoidance(Crowd(3, 0.05), BOXES).shaped(Barrier(gamma=8.0, pairs="all"), 0.01)
    c, pullback = ours.vjp(x)
    weights = torch.randn_like(c)
    default, by_default = Constraint.vjp(ours, x)
    torch.testing.assert_close(c, default)
    torch.testing.assert_close(pullback(weights), by_default(weights))


@crowds
@pytest.mark.parametrize("count", [2, 10, 20])
def test_a_scene_is_a_function_of_its_name(task: str, count: int) -> None:
    made, larger = CROWDS[task](count), CROWDS[task]([count, 28])
    first = made.scene(count, seed=3, index=5)
    assert first.shape == (2, 2 * count)
    assert torch.equal(first, larger.scene(count, 3, 5))
    for other in (made.scene(count, 3, 6), made.scene(count, 4, 5)):
        assert not torch.equal(first, other)
    points = first.view(2, count, 2)
    assert points.abs().max() <= 0.95
    between = torch.stack([torch.pdist(one) for one in points])
    assert between.min() > 0.149  # 0.15, less the jitter


def test_robots_of_weave_cross_straight_to_the_other_side() -> None:
    start, goal = CROWDS["weave"](28).scene(28, 0, 0).view(2, 28, 2)
    crossing = (start - goal).abs()
    assert ((crossing > 1).sum(dim=1) == 1).all()
    assert torch.equal(crossing.amax(dim=1), torch.full((28,), 2 * torch.tensor(0.87).item()))
    theta = torch.atan2(start[:, 1], start[:, 0]).sort().values
    assert theta.diff().min() > 0.1


@pytest.mark.parametrize("count", [10, 40, 64])
def test_a_scaled_world_has_room_for_more_robots_of_the_same_size(count: int) -> None:
    """In its own units discs have radius 0.05, and starts keep 0.15 but for their jitter."""
    made = CROWDS["scaled_weave"](count)
    scale = made.scale
    assert isinstance(scale, float)
    assert scale * made.robots.radius == pytest.approx(0.05)
    assert (scale == 1) == (count == 10)
    start = scale * made.scene(count, 0, 0)[0].view(count, 2).double()
    apart = (torch.cdist(start, start) + 9 * torch.eye(count)).min()
    assert float(apart) >= 0.149
    if count > 28:
        assert float(apart) <= 0.165
    same = CROWDS["scaled_weave"](10).of_numbers(2 * count)
    assert (same.scale, float(same.robots.radii[0])) == (scale, made.robots.radius)


def test_robots_of_circle_swap_with_their_antipodes_nearly() -> None:
    start, goal = CROWDS["circle"](10).scene(10, 0, 0).view(2, 10, 2)
    assert torch.equal(goal, -start)
    torch.testing.assert_close(start.norm(dim=1), torch.full((10,), 0.8))
    theta = torch.atan2(start[:, 1].double(), start[:, 0].double()) % (2 * math.pi)
    away = theta - 2 * math.pi * torch.arange(10) / 10
    away = (away + math.pi) % (2 * math.pi) - math.pi
    assert away.abs().max() <= PHASE + JITTER * 2 * math.pi / 10 + 1e-6


def test_too_many_robots_are_refused() -> None:
    with pytest.raises(ValueError, match=r"robots=300: expected fewer"):
        CROWDS["random"](300).scene(300, 0, 0)
    with pytest.raises(DemonstrationError, match=r"^robots=64: expected fewer, so many of radius 0.05 find no room$"):
        CROWDS["weave"](64).demonstrations(2, seed=0)
    CROWDS["weave"](64, radius=0.01).demonstrations(2, seed=0)


@crowds
def test_demonstrations_are_of_single_robots_and_collide(task: str) -> None:
    made = CROWDS[task](20)
    x = made.demonstrations(40, seed=1)
    assert x.shape == (40, made.T, 40)
    assert torch.equal(x, made.demonstrations(40, seed=1))
    assert torch.equal(x[:, [0, -1]], torch.stack([made.scene(20, 1, i) for i in range(40)]))
    share = made.constraints()["robot"].violation(x).float().mean()
    assert share > 0.9


@pytest.mark.parametrize("task", ["random", "highways", "conveyor", "shelf", "room"])
def test_demonstrations_stay_inside_and_clear_of_a_map(task: str) -> None:
    made = CROWDS[task](9)
    x = made.demonstrations(60, seed=2)
    check(x, task)
    if made.boxes():
        single = x.unflatten(2, (-1, 2)).transpose(1, 2).flatten(0, 1)
        assert float(MapAvoidance(Crowd(1, 0.05), made.boxes()).swept_clearance(single).min()) >= 0
        ends = made.scene(9, 2, 0).view(18, 1, 2)
        assert (MapAvoidance(Crowd(1, 0.1), made.boxes()).clearance(ends) >= 0).all()


@pytest.mark.parametrize(("task", "discs"), [("basic", 10), ("dense", 20)])
def test_every_scene_of_these_has_discs_of_its_own(task: str, discs: int) -> None:
    made = CROWDS[task](9)
    assert made.boxes() == ()
    first, second = (made.in_scene(9, 1, index) for index in range(2))
    assert first.boxes() == made.in_scene(9, 1, 0).boxes() != second.boxes()
    assert len(first.boxes()) == discs
    assert set(made.constraints()) == {"robot"}
    assert set(first.constraints()) == {"robot", "object"}
    places = torch.tensor([[box.x, box.y] for box in first.boxes()])
    radii = torch.tensor([box.rounding for box in first.boxes()])
    assert 0.05 <= float(radii.min()) <= float(radii.max()) <= 0.1
    gaps = torch.cdist(places, places) - radii[:, None] - radii
    assert float((gaps + 9 * torch.eye(discs)).min()) >= 0.1 - 1e-6
    away = MapAvoidance(Crowd(1, 0.11), first.boxes()).clearance(made.scene(9, 1, 0).view(18, 1, 2))
    assert float(away.min()) >= -1e-6


def test_a_single_robot_leaves_its_line_by_sinusoids_of_its_length() -> None:
    ends = torch.tensor([[0.0, 0.0], [0.0, 2.0]]).expand(3000, -1, -1)
    x = singles(ends, 64, torch.Generator().manual_seed(0)).double()
    s = torch.linspace(0, 1, 64, dtype=torch.float64)
    waves = torch.sin(math.pi * torch.arange(1, 4)[:, None] * s)
    across = torch.linalg.lstsq(waves.mT, x[..., 0].mT).solution
    along = torch.linalg.lstsq(waves.mT, (x[..., 1] - 2 * s).mT).solution
    for found, share in ((across, 1.0), (along, ALONG)):
        largest = found.abs().amax(dim=1)
        bound = 2 * share * torch.tensor(AMPLITUDES, dtype=torch.float64)
        assert (largest <= bound + 1e-6).all()
        assert (largest > 0.95 * bound).all()


@pytest.fixture
def network() -> SpectralAttention:
    made = attention(Crowd(6, 0.05))
    torch.manual_seed(0)
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return made


def attention(robots: Crowd) -> SpectralAttention:
    constraint = CrowdAvoidance(robots).shaped(Barrier(pairs="all"))
    return SpectralAttention(cgp(64, modes=5), 2, constraint, robots.apart, hidden=16, blocks=2)


def permuted(x: Tensor, order: Tensor) -> Tensor:
    return x.unflatten(2, (-1, 2))[:, :, order].flatten(2)


@pytest.mark.parametrize("count", [2, 6, 9])
def test_attention_does_not_care_which_robot_is_which_nor_how_many(network: SpectralAttention, count: int) -> None:
    x = 0.3 * torch.randn(3, 64, 2 * count, generator=torch.Generator().manual_seed(0))
    t, order = torch.tensor([0.0, 0.4, 1.0]), torch.randperm(count, generator=torch.Generator().manual_seed(1))
    v = network(x, t)
    assert v.shape == x.shape
    torch.testing.assert_close(network(permuted(x, order), t), permuted(v, order), rtol=1e-4, atol=1e-5)
    assert torch.equal(v[:, [0, -1]], torch.zeros_like(v[:, [0, -1]]))  # where the source is conditioned
    assert not torch.equal(v, attention(Crowd(6, 0.05))(x, t))


def test_robots_attend_to_each_other(network: SpectralAttention) -> None:
    x = 0.3 * torch.randn(1, 64, 8, generator=torch.Generator().manual_seed(0))
    moved = x.clone()
    moved[..., 6:] += 0.1
    t = torch.tensor([0.5])
    assert not torch.allclose(network(x, t)[..., :2], network(moved, t)[..., :2], atol=1e-6)


def test_attention_begins_as_the_gaussian_flow_of_its_demonstrations() -> None:
    """One variance for all robots: of demonstrations that are the source's own samples the velocity is its flow's."""
    robots, source = Crowd(6, 0.05), cgp(64, modes=5)
    made = attention(robots)
    y = torch.zeros(4000, 2, 12)
    made.fit(2 * source.sample(y, torch.Generator().manual_seed(0)))
    ratio = made.variance / made.source_variance
    torch.testing.assert_close(ratio, torch.full_like(ratio, 4.0), rtol=0.05, atol=0)  # 48,000 squares: 5 deviations
    x = source.sample(y[:10], torch.Generator().manual_seed(1))
    torch.testing.assert_close(made(x, torch.zeros(10)), -x, rtol=1e-4, atol=1e-4)


def test_training_takes_turns_between_numbers_of_robots() -> None:
    settings = config.load(["task=weave", "ablation=plus", "preset=smoke", "task.robots=[4, 6]", "data.num=30"])
    data = DemonstrationData(settings)
    assert (data.task.robots.count, data.train.x.shape[2], [one.x.shape[2] for one in data.others]) == (6, 12, [8])
    batches = Batches(data.train, 8, 4, seed=0, negative_share=0.05, others=data.others)
    assert [x.shape for x, _ in batches] == [(8, 64, 12), (12, 64, 8)] * 2
    alone = DemonstrationData(
        config.load([*("task=weave", "ablation=plus", "preset=smoke", "task.robots=6", "data.num=30")])
    )
    assert torch.equal(alone.train.x, data.train.x)
    assert alone.digest != data.digest
    # Repaired: what was in collision no longer is, at the same starts and goals.
    assert data.violates.float().mean() > 0.4
    assert not data.train.violates.any()


def test_demonstrations_are_the_same_for_a_trained_model_whose_source_is_fitted() -> None:
    """Their repair is another one then, but it is of the same demonstrations."""
    settings = config.load(["task=weave", "ablation=plus", "preset=smoke", "task.robots=[4, 6]", "data.num=30"])
    data = DemonstrationData(settings)
    again = DemonstrationData(fitted(settings, data.known))
    assert again.digest == data.digest
    assert not torch.equal(again.train.x, data.train.x)
    known_again = DemonstrationData(fitted(settings, data.known), training=False)
    assert known_again.digest == data.digest
    assert torch.equal(known_again.held_out["val"].x, data.held_out["val"].x)
    assert not hasattr(known_again, "train")


def test_one_class_alone_fills_a_batch_whatever_its_share_should_be() -> None:
    x = torch.zeros(10, 3, 4)
    for violates in (torch.zeros(10, dtype=torch.bool), torch.ones(10, dtype=torch.bool)):
        (first, M), *_ = Batches(Split(x, violates), 6, 1, seed=0, negative_share=0.25)
        assert len(first) == 6
        assert bool((violates[0] == M).all())


def test_demonstrations_that_all_collide_are_refused_only_where_a_method_needs_others() -> None:
    arguments = ["task=weave", "preset=smoke", "task.robots=20", "data.num=30", "data.repair=false"]
    data = DemonstrationData(config.load([*arguments, "ablation=plus"]))
    assert data.train.violates.all()
    assert torch.equal(data.known, data.train.x)
    with pytest.raises(
        ValueError, match=r"no trajectory for training is feasible out of 24, and ablation fm needs D\+$"
    ):
        DemonstrationData(config.load([*arguments, "ablation=fm"]))


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("task.robots=1", "task weave: robots=1: expected a whole number of at least 2"),
        ("task.robots=[10, 2.5]", "task weave: robots=[10, 2.5]: expected a whole number of at least 2"),
        ("task.robots=many", "task weave: robots=many: expected"),
        ("task.radius=0.2", "task weave: radius=0.2: expected a number above 0 and at most 0.075"),
        ("task.radius=wide", "task weave: radius=wide: expected a number"),
        ("task.robot=10", "task.robot=10: no such setting of task weave, expected one of robots, radius; did you mean"),
    ],
)
def test_a_setting_of_a_crowd_that_cannot_be_is_refused(argument: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        build_task(config.load(["task=weave", argument]))
    assert str(refused.value).startswith(said)


def test_a_task_of_swaps_has_no_settings_of_its_own() -> None:
    with pytest.raises(ConfigError, match=r"^task\.robots=3: task swap has no settings of its own$"):
        build_task(config.load(["task.robots=3"]))


def test_apart_is_the_gap_of_every_two() -> None:
    x = trajectories(5)
    gaps = Crowd(9, 0.1).apart(x)
    i, j = np.triu_indices(5, 1)
    torch.testing.assert_close(gaps[:, :, i, j], CrowdAvoidance(Crowd(9, 0.1)).clearances(x))
    torch.testing.assert_close(gaps, gaps.mT)


def test_a_crowd_of_other_numbers_is_the_same_task() -> None:
    made = CROWDS["weave"]([10, 20], radius=0.04)
    made.scale, made.seconds = 3.0, 2.0
    other = made.of_numbers(14)
    assert isinstance(other, CrowdTask)
    assert (other.robots.count, other.robots.radius, other.scale, other.seconds) == (7, 0.04, 3.0, 2.0)


def test_other_numbers_of_a_crowd_keep_the_offset_of_each() -> None:
    made = CROWDS["weave"](10)
    made.offset = [3.0, 4.0] * 10
    assert made.of_numbers(28).offset == [3.0, 4.0] * 14
    assert made.of_numbers(4).offset == [3.0, 4.0] * 2


@pytest.mark.parametrize("name", ["basic", "room"])
def test_fewer_robots_than_a_task_has_plan_around_its_map_too(name: str) -> None:
    """A scene's own discs went missing where its robots were fewer than the most that the task trains with."""
    made = CROWDS[name]().in_scene(9, 1, 0)
    assert made.robots.count > 9
    start, goal = made.scene(9, 1, 0)
    planner = DescentPlanner.of(made)
    around = MapAvoidance(Crowd(9, made.radius), made.boxes())
    for plans in (planner.plan(start, goal, num=8), planner.best_of(start, goal, num=8)):
        clear = around.swept_clearance(plans.x).amin(dim=1) >= 0
        assert bool(plans.feasible.any())
        assert not bool((plans.feasible & ~clear).any())


def test_a_network_with_layers_for_one_number_of_robots_refuses_others() -> None:
    """Training took the largest number alone, and ended in torch's traceback at the first batch of another."""
    chosen = config.load(["task=weave", "preset=smoke"])
    with pytest.raises(ConfigError, match=r"^network.kind=resmlp: expected robots of one number, found 10, 20, 28 in"):
        ConFlow(chosen, build_task(chosen))
    chosen = config.load(["task=weave", "preset=smoke", "task.robots=4"])
    model = ConFlow(chosen, build_task(chosen))
    start, goal = CROWDS["weave"](6).scene(6, 0, 0)
    with pytest.raises(PlanError, match=r"found shape \(12,\), expected numbers of shape \(8,\)"):
        Planner(model).plan(start, goal)
    with pytest.raises(ConfigError, match=r"^task.robots=6: expected 4, for which alone this network has layers"):
        model.on(CROWDS["weave"](6))
