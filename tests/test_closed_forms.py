"""Constraints of every kind: closed forms against the defaults that they override, radii, pairs, margins, limits."""

import math
from typing import get_args

import pytest
import torch
from torch import Tensor

from conflow.scene import constraint as constraint_module
from conflow.scene.constraint import (
    AccelerationLimit,
    Barrier,
    Constraint,
    ObstacleAvoidance,
    RobotAvoidance,
    SpeedLimit,
    Sum,
    Workspace,
)
from conflow.scene.measures import keeps
from conflow.scene.robots import Discs, Robots
from conflow.scene.settings import BarrierShape, Obstacle, Pairs, Reduction
from tests.papers import TWO, keep_apart
from tests.test_constraint import OBSTACLES, THREE, reductions, shapes

UNEQUAL = Discs(3, radius=[0.05, 0.1, 0.3])
ONE = Discs(1, radius=0.1)


def densely(x: Tensor, parts: int) -> Tensor:
    """The same straight lines with `parts` - 1 more waypoints on each, evenly, (batch, (T - 1) parts + 1, D)."""
    tau = torch.arange(parts, dtype=x.dtype)[:, None] / parts
    return torch.cat([torch.lerp(x[:, :-1, None], x[:, 1:, None], tau).flatten(1, 2), x[:, -1:]], dim=1)


class Arms(Robots):
    """Two arms of two links that stand on the x-axis: D = 4 joints, two bodies each, of radii of their own."""

    def __init__(self) -> None:
        self.D, self.owner = 4, torch.tensor([0, 0, 1, 1])
        self.radii = torch.tensor([0.1, 0.05, 0.2, 0.05], dtype=torch.float64)

    def points(self, x: Tensor) -> Tensor:
        bases = torch.tensor([[-0.4, 0.0], [0.4, 0.0]], dtype=x.dtype)
        angle = x.unflatten(2, (2, 2)).cumsum(dim=3)  # of each link against the x-axis
        links = 0.5 * torch.stack([angle.cos(), angle.sin()], dim=4)
        return (bases[:, None] + links.cumsum(dim=3)).flatten(2, 3)

    def pullback(self, x: Tensor, g: Tensor) -> Tensor:
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            return torch.autograd.grad(self.points(x), x, g)[0]


class Balls(Robots):
    """Spheres in space, D = 3 for each."""

    def __init__(self, count: int, radius: float) -> None:
        self.D, self.owner = 3 * count, torch.arange(count)
        self.radii = torch.full((count,), radius, dtype=torch.float64)

    def points(self, x: Tensor) -> Tensor:
        return x.unflatten(2, (-1, 3))

    def pullback(self, x: Tensor, g: Tensor) -> Tensor:
        return g.flatten(2)


class WithinACircle(Constraint):
    """Of one's own, with a clearance alone: every disc's centre keeps within 1.5 of the origin."""

    def clearance(self, x: Tensor) -> Tensor:
        return 1.5 - torch.linalg.vector_norm(self.robots.points(x), dim=3).amax(dim=2)


class ShortSteps(Constraint):
    """Of one's own, with a clearance of steps between waypoints: none is longer than 1."""

    def clearance(self, x: Tensor) -> Tensor:
        c = 1 - torch.linalg.vector_norm(self.robots.points(x).diff(dim=1), dim=3).amax(dim=2)
        return torch.minimum(torch.cat([c[:, :1], c], dim=1), torch.cat([c, c[:, -1:]], dim=1))


# All that override a default, for discs that are alike, discs with radii of their own, arms and spheres in space.
CLOSED_FORMS: dict[str, Constraint] = {
    "two robots": RobotAvoidance(TWO),
    "three robots": RobotAvoidance(THREE),
    "robots of unequal radii": RobotAvoidance(UNEQUAL),
    "arms": RobotAvoidance(Arms()),
    "spheres": RobotAvoidance(Balls(3, 0.2)),
    "obstacles": ObstacleAvoidance(THREE, OBSTACLES),
    "obstacles and unequal radii": ObstacleAvoidance(UNEQUAL, OBSTACLES),
    "obstacles and arms": ObstacleAvoidance(Arms(), OBSTACLES),
    "walls": Workspace(THREE, -1.0),
    "walls with a margin": Workspace(UNEQUAL, 0.1),
    "walls and arms": Workspace(Arms(), -0.2),
    "a margin more": RobotAvoidance(UNEQUAL).narrowed(0.05),
    "a margin more of one's own": WithinACircle(THREE).narrowed(0.05),
}
closed_forms = pytest.mark.parametrize("constraint", CLOSED_FORMS.values(), ids=CLOSED_FORMS)
ALL: dict[str, Constraint] = CLOSED_FORMS | {
    "one's own": WithinACircle(THREE),
    "one's own of steps": ShortSteps(THREE),
    "speed": SpeedLimit(UNEQUAL, 6.0, dt=0.5),
    "acceleration": AccelerationLimit(UNEQUAL, 16.0, dt=0.5),
    "one robot and walls": Workspace(ONE, 0.1),
    "one robot and obstacles": ObstacleAvoidance(ONE, OBSTACLES),
    "one robot's speed": SpeedLimit(ONE, 4.0, dt=0.5),
    "a sum": Sum([RobotAvoidance(UNEQUAL), WithinACircle(UNEQUAL), SpeedLimit(UNEQUAL, 6.0, dt=0.5)]),
    "a sum of a sum": Sum([Sum([RobotAvoidance(THREE), Workspace(THREE)]), ObstacleAvoidance(THREE, OBSTACLES)]),
}
every_constraint = pytest.mark.parametrize("constraint", ALL.values(), ids=ALL)


def configurations(robots: Robots, batch: int = 64, T: int = 6) -> Tensor:
    """Trajectories (batch, T, D) about the origin, some in violation and some not."""
    generator = torch.Generator().manual_seed(0)
    return 0.8 * torch.randn(batch, T, robots.D, dtype=torch.float64, generator=generator)


@closed_forms
def test_a_closed_form_of_the_pullback_is_the_automatic_one(constraint: Constraint) -> None:
    """Clearances and the gradient of sum g c for any weights g, against the default that every constraint has."""
    x = configurations(constraint.robots)
    (c, pullback), (expected, automatic) = constraint.vjp(x), Constraint.vjp(constraint, x)
    assert torch.equal(c, expected)
    g = torch.randn(c.shape, dtype=c.dtype, generator=torch.Generator().manual_seed(1))
    # float64 rounding of sums of some ten terms
    torch.testing.assert_close(pullback(g), automatic(g), rtol=1e-12, atol=1e-12)


@every_constraint
@shapes
@reductions
@pytest.mark.parametrize("margin", [0.0, 0.05])
def test_the_gradient_of_every_constraint_is_that_of_its_barrier(
    constraint: Constraint, shape: BarrierShape, reduction: Reduction, margin: float
) -> None:
    """torch.autograd on `barrier`, with every barrier and with a margin too."""
    # Beyond gamma c = -20 torch's softplus is linear and its slope 1: so far nothing here goes with gamma = 1.
    shaped = constraint.shaped(Barrier(shape, reduction, gamma=1), margin)
    x = configurations(constraint.robots).requires_grad_()
    (expected,) = torch.autograd.grad(shaped.barrier(x).sum(), x)
    gradient = shaped.gradient(x.detach())
    assert bool(gradient.any())
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=1e-12)  # float64 rounding


@every_constraint
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_sweep_says_more_than_the_waypoints(constraint: Constraint, dtype: torch.dtype) -> None:
    """To the last bit: what violates at a waypoint violates on the way too, also by the default of one's own."""
    x = configurations(constraint.robots, batch=500).to(dtype)
    c, swept = constraint.clearance(x), constraint.swept_clearance(x)
    assert c.shape == (500, 6)
    assert swept.shape == (500, 5)
    assert bool((swept.amin(dim=1) <= c.amin(dim=1)).all())
    assert not bool((constraint.violation(x) & keeps(constraint, x)).any())
    # A waypoint answers for the faster of the two steps beside it, a step for itself alone.
    if not any(isinstance(one, SpeedLimit) for one in constraint.modules()):
        assert bool((swept <= torch.minimum(c[:, :-1], c[:, 1:])).all())


STRAIGHT = {name: one for name, one in CLOSED_FORMS.items() if not isinstance(one.robots, Arms)}
"""Where a body goes straight while the configuration does."""


@pytest.mark.parametrize("constraint", STRAIGHT.values(), ids=STRAIGHT)
@pytest.mark.parametrize("parts", [8, 512])
def test_a_closed_form_of_the_sweep_is_the_limit_of_subdivision(
    constraint: Constraint, parts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is below the default, and by no more than half a part's change of the separation."""
    monkeypatch.setattr(constraint_module, "PARTS", parts)
    x = configurations(constraint.robots, batch=32)
    default, swept = Constraint.swept_clearance(constraint, x), constraint.swept_clearance(x)
    assert bool((swept <= default + 1e-12).all())  # float64 rounding
    # A separation changes by what both bodies move; the nearest of evenly spaced points is half a part away.
    step = torch.linalg.vector_norm(constraint.robots.points(x).diff(dim=1), dim=3).amax(dim=2)
    assert bool((default - swept <= 2 * step / (2 * parts)).all())


@pytest.mark.parametrize("constraint", STRAIGHT.values(), ids=STRAIGHT)
@pytest.mark.parametrize("parts", [3, 64])
def test_a_closed_form_of_the_sweep_does_not_depend_on_the_waypoints_of_a_line(
    constraint: Constraint, parts: int
) -> None:
    """More waypoints on the same straight lines: the smallest of the parts is that of the whole."""
    x = configurations(constraint.robots, batch=32)
    fine = constraint.swept_clearance(densely(x, parts)).unflatten(1, (-1, parts)).amin(dim=2)
    torch.testing.assert_close(fine, constraint.swept_clearance(x), rtol=0, atol=1e-12)  # float64 rounding


def test_a_sweep_of_equal_parts_finds_what_lies_on_one_of_them_to_rounding() -> None:
    """Robots that meet in the middle of a step do so at part 4 of 8, where the default looks too."""
    x = torch.tensor([[[-0.6, 0.1, 0.6, 0.1], [0.6, 0.1, -0.6, 0.1]]], dtype=torch.float64)
    constraint = keep_apart(2, 0.3)
    found = Constraint.swept_clearance(constraint, x)
    torch.testing.assert_close(found, constraint.swept_clearance(x), rtol=0, atol=1e-15)
    assert found.item() == pytest.approx(-0.3, abs=1e-7)  # the radius is kept in float32


def test_a_constraint_of_ones_own_is_seen_between_its_waypoints() -> None:
    """A disc that leaves a circle by a chord's other side shows in the default's parts alone."""

    class OutsideACircle(Constraint):
        def clearance(self, x: Tensor) -> Tensor:
            return torch.linalg.vector_norm(x, dim=2) - 0.5

    x = torch.tensor([[[-1.0, 0.25], [1.0, 0.25]]], dtype=torch.float64)
    constraint = OutsideACircle(ONE)
    assert constraint.violation(x).tolist() == [False]
    assert constraint.swept_clearance(x).tolist() == [[-0.25]]  # half-way, where part 4 of 8 is


def test_a_clearance_of_steps_is_not_larger_of_the_smaller_steps_of_a_sweep() -> None:
    """Its author knows nothing of parts: a step of 1.5 stays one where the default divides it into eight."""
    x = torch.tensor([[[0.0, 0.0], [0.5, 0.0], [2.0, 0.0]]], dtype=torch.float64)
    assert ShortSteps(ONE).swept_clearance(x).tolist() == [[-0.5, -0.5]]


def test_discs_of_unequal_radii_touch_at_the_sum_of_their_radii() -> None:
    """Radii of 1/16, 1/8 and 1/4, exact in float32, pair by pair and with an obstacle of 1/8."""
    robots = Discs(3, radius=[1 / 16, 1 / 8, 1 / 4])
    x = torch.tensor([[[0.0, 0.0, 0.5, 0.0, 0.5, 1.0]]])
    pairs = RobotAvoidance(robots).clearances(x).flatten().tolist()
    assert pairs == pytest.approx([0.5 - 3 / 16, math.sqrt(1.25) - 5 / 16, 1 - 3 / 8], abs=1e-7)  # float32
    assert pairs[0] == 0.5 - 3 / 16
    obstacle = ObstacleAvoidance(robots, [Obstacle(0.5, 0.5, 1 / 8)])
    expected = [math.sqrt(0.5) - 3 / 16, 0.5 - 2 / 8, 0.5 - 3 / 8]
    assert obstacle.clearances(x).flatten().tolist() == pytest.approx(expected, abs=1e-7)
    assert obstacle.clearance(x).item() == 0.125


@pytest.mark.parametrize("gap", [-(2.0**-20), 0.0, 2.0**-20])
def test_only_the_pair_that_overlaps_decides(gap: float) -> None:
    """A large disc is in the way of others where a small one at the same place is not."""
    robots = Discs(3, radius=[1 / 16, 1 / 8, 1 / 4])
    x = torch.tensor([[[-0.75, 0.0, 0.0, 0.0, 3 / 8 + gap, 0.0]]])
    assert RobotAvoidance(robots).clearance(x).item() == gap
    exchanged = x[..., [4, 5, 2, 3, 0, 1]]  # the large disc where the small one was, and the other way round
    assert RobotAvoidance(robots).clearance(exchanged).item() == 3 / 8 + gap - 3 / 16


def test_equal_radii_one_by_one_are_the_same_as_one_for_all() -> None:
    x = configurations(THREE)
    for kind in (RobotAvoidance, lambda robots: ObstacleAvoidance(robots, OBSTACLES)):
        alike, each = kind(Discs(3, radius=0.15)), kind(Discs(3, radius=[0.15, 0.15, 0.15]))
        assert torch.equal(alike.clearances(x), each.clearances(x))
        assert torch.equal(alike.gradient(x), each.gradient(x))


@pytest.mark.parametrize(
    ("count", "radius"), [(0, 0.1), (-1, 0.1), (2, [0.1]), (2, [0.1, 0.1, 0.1]), (2, -0.1), (2, math.nan), (1, [])]
)
def test_discs_without_a_radius_each_are_refused(count: int, radius: float | list[float]) -> None:
    with pytest.raises(ValueError, match="expected one or more, with a radius for all or each"):
        Discs(count, radius)


def test_bodies_of_one_robot_do_not_avoid_each_other() -> None:
    """Two arms of two bodies are four pairs; an arm that folds onto itself keeps its clearance."""
    x = torch.zeros(1, 1, 4, dtype=torch.float64)
    x[..., 1] = math.pi  # the first arm's hand is back at its base
    x[..., 2] = 0.5
    arms = Arms()
    c = RobotAvoidance(arms).clearances(x).flatten().tolist()
    p, r = arms.points(x)[0, 0].tolist(), arms.radii.tolist()
    # radii are kept in float32
    assert c == pytest.approx([math.dist(p[i], p[j]) - r[i] - r[j] for i in (0, 1) for j in (2, 3)], abs=1e-7)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@shapes
def test_of_all_pairs_the_barriers_add_up(shape: BarrierShape, reduction: Reduction) -> None:
    """C of three robots is that of each two of them, one pair after the other, and so is its gradient."""
    every = RobotAvoidance(UNEQUAL).shaped(Barrier(shape, reduction, pairs="all"))
    x = configurations(THREE)
    barrier, gradient = torch.zeros(len(x), dtype=x.dtype), torch.zeros_like(x)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        numbers = [2 * i, 2 * i + 1, 2 * j, 2 * j + 1]
        radii = UNEQUAL.radii[[i, j]].tolist()
        two = RobotAvoidance(Discs(2, radii)).shaped(Barrier(shape, reduction))
        barrier += two.barrier(x[..., numbers])
        gradient[..., numbers] += two.gradient(x[..., numbers])
    # float64 rounding of sums of 18 terms
    torch.testing.assert_close(every.barrier(x), barrier, rtol=0, atol=1e-13)
    torch.testing.assert_close(every.gradient(x), gradient, rtol=0, atol=1e-13)
    nearest = RobotAvoidance(UNEQUAL).shaped(Barrier(shape, reduction))
    assert bool((every.barrier(x) <= nearest.barrier(x) + 1e-13).all())
    assert bool((every.barrier(x) < nearest.barrier(x)).any())


@every_constraint
@pytest.mark.parametrize("reduction", ["sum", "mean"])
@shapes
def test_the_gradient_of_all_pairs_is_autograds(
    constraint: Constraint, shape: BarrierShape, reduction: Reduction
) -> None:
    shaped = constraint.shaped(Barrier(shape, reduction, gamma=1, pairs="all"), 0.05)
    x = configurations(constraint.robots).requires_grad_()
    (expected,) = torch.autograd.grad(shaped.barrier(x).sum(), x)
    torch.testing.assert_close(shaped.gradient(x.detach()), expected, rtol=1e-12, atol=1e-12)  # float64 rounding


def test_of_one_pair_the_nearest_is_all() -> None:
    x = configurations(TWO)
    nearest, every = (keep_apart(2, 0.3, Barrier(pairs=pairs)) for pairs in get_args(Pairs))
    assert torch.equal(nearest.barrier(x), every.barrier(x))
    assert torch.equal(nearest.gradient(x), every.gradient(x))


@every_constraint
@pytest.mark.parametrize("margin", [0.05, -0.05])
def test_with_a_margin_all_clearances_are_smaller_by_it(constraint: Constraint, margin: float) -> None:
    """At waypoints, of every pair and on the way; what M says follows, and the constraint itself stays as it is."""
    x = configurations(constraint.robots)
    before, shape = constraint.clearance(x), constraint.shape
    shaped = constraint.shaped(Barrier("relu", gamma=3), margin)
    for name in ("clearance", "clearances", "swept_clearance"):
        smaller, own = getattr(shaped, name)(x), getattr(constraint, name)(x)
        torch.testing.assert_close(smaller, own - margin, rtol=0, atol=1e-7)  # radii are kept in float32
    assert torch.equal(shaped.violation(x), shaped.clearance(x).amin(dim=1) < 0)
    assert torch.equal(constraint.clearance(x), before)
    assert constraint.shape == shape


@every_constraint
def test_margins_add_up_and_the_last_barrier_holds(constraint: Constraint) -> None:
    x = configurations(constraint.robots)
    once = constraint.shaped(Barrier("relu"), 0.08)
    twice = constraint.shaped(Barrier("softplus", "closest"), 0.05).shaped(Barrier("relu"), 0.03)
    torch.testing.assert_close(twice.clearance(x), once.clearance(x), rtol=0, atol=1e-7)  # radii are kept in float32
    torch.testing.assert_close(twice.barrier(x), once.barrier(x), rtol=0, atol=1e-5)  # of some hundred of them
    assert torch.equal(constraint.shaped(Barrier()).clearance(x), constraint.clearance(x))


def along(positions: Tensor) -> Tensor:
    """One trajectory of one disc with these x-coordinates, (1, T, 2)."""
    return torch.stack([positions, torch.zeros_like(positions)], dim=1)[None]


@pytest.mark.parametrize(("speed", "violates"), [(0.5, False), (2.0, False), (2.01, True)])
def test_the_clearance_of_a_constant_speed_is_what_is_left_to_the_limit(speed: float, violates: bool) -> None:
    """c = limit - v at every waypoint and on every way, in any direction, whatever T and seconds."""
    T, seconds = 9, 0.5
    dt = seconds / (T - 1)
    s = torch.linspace(0, speed * seconds, T, dtype=torch.float64)
    x = torch.stack([0.6 * s, -0.8 * s], dim=1)[None]
    limit = SpeedLimit(ONE, 2.0, dt)
    expected = torch.full((1, T), 2.0 - speed, dtype=x.dtype)
    torch.testing.assert_close(limit.clearance(x), expected, rtol=0, atol=1e-13)  # float64 rounding over dt
    torch.testing.assert_close(limit.swept_clearance(x), expected[:, 1:], rtol=0, atol=1e-13)
    assert limit.shaped(Barrier(), -1e-9).violation(x).tolist() == [violates]


def test_the_fastest_body_and_the_faster_step_decide_about_speed() -> None:
    """Steps of 0.1, 0.3 and 0.2 in a tenth of a second: speeds of 1, 3 and 2, at a waypoint the larger one beside."""
    fast = torch.tensor([0.0, 0.1, 0.4, 0.6], dtype=torch.float64)
    x = torch.zeros(1, 4, 6, dtype=torch.float64)
    x[..., 2] = fast  # the two others stand still
    limit = SpeedLimit(THREE, 2.5, dt=0.1)
    assert limit.swept_clearance(x)[0].tolist() == pytest.approx([1.5, -0.5, 0.5])
    assert limit.clearance(x)[0].tolist() == pytest.approx([1.5, -0.5, -0.5, 0.5])


@pytest.mark.parametrize("parts", [2, 7])
def test_a_speed_is_the_same_of_any_division_of_the_way(parts: int) -> None:
    """More waypoints on the same lines in as much shorter times change nothing."""
    x = configurations(THREE)
    fine = SpeedLimit(THREE, 20.0, 0.1 / parts).swept_clearance(densely(x, parts)).unflatten(1, (-1, parts))
    coarse = SpeedLimit(THREE, 20.0, 0.1).swept_clearance(x)
    # float64 rounding of speeds up to 50 over dt
    torch.testing.assert_close(fine, coarse[..., None].expand_as(fine), rtol=0, atol=1e-11)


@pytest.mark.parametrize(("limit", "violates"), [(7.9, True), (8.1, False)])
def test_the_clearance_of_a_parabola_is_what_its_acceleration_leaves_to_the_limit(limit: float, violates: bool) -> None:
    """p = a t^2 / 2 with a = 8: second differences are a dt^2 exactly, at start and goal too."""
    t = torch.linspace(0, 0.5, 11, dtype=torch.float64)
    x = torch.stack([0.6 * 4 * t**2, 0.8 * 4 * t**2], dim=1)[None]
    constraint = AccelerationLimit(ONE, limit, dt=0.05)
    expected = torch.full((1, 11), limit - 8, dtype=x.dtype)
    torch.testing.assert_close(constraint.clearance(x), expected, rtol=0, atol=1e-12)  # float64 rounding over dt^2
    torch.testing.assert_close(constraint.swept_clearance(x), expected[:, 1:], rtol=0, atol=1e-12)
    assert constraint.violation(x).tolist() == [violates]
    # However fast, a straight line driven evenly takes none, but for 1e-12 / dt^2 that keep the root's slope finite.
    assert AccelerationLimit(ONE, 0.0, 0.05).clearance(along(50 * t)).abs().max() < 1e-9


def test_one_jump_of_the_velocity_is_an_acceleration_at_its_waypoint_and_on_both_ways_beside() -> None:
    """Standing, then at speed 1 with dt = 0.1: a jump of 1 in one step is an acceleration of 10."""
    x = along(torch.tensor([0, 0, 0, 0.1, 0.2, 0.3], dtype=torch.float64))
    constraint = AccelerationLimit(ONE, 4.0, dt=0.1)
    assert constraint.clearance(x)[0].tolist() == pytest.approx([4, 4, -6, 4, 4, 4])
    assert constraint.swept_clearance(x)[0].tolist() == pytest.approx([4, -6, -6, 4, 4])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", [SpeedLimit, AccelerationLimit])
@pytest.mark.parametrize("shape", [Barrier("softplus"), Barrier("relu"), Barrier("softplus", pairs="all")])
def test_what_stands_still_has_a_gradient_and_is_not_pushed(
    kind: type[SpeedLimit | AccelerationLimit], shape: Barrier, dtype: torch.dtype
) -> None:
    """|0| has no derivative: 0 stands for it, also where the limit of 0 makes the barrier steep, and beside a mover."""
    standing = torch.full((1, 5, 4), 0.3, dtype=dtype)
    for limit in (0.0, 1.0):
        gradient = kind(TWO, limit, 0.1).shaped(shape).gradient(standing)
        assert torch.equal(gradient, torch.zeros_like(standing))
    moving = standing.clone()
    moving[0, :, 2] = torch.tensor([-0.5, -0.4, 0.2, 0.3, 0.4], dtype=dtype)
    gradient = kind(TWO, 1.0, 0.1).shaped(shape).gradient(moving)
    assert bool(gradient.isfinite().all())
    assert bool(gradient[..., 2].any())
    assert not bool(gradient[..., :2].any())


@pytest.mark.parametrize("constraint", [SpeedLimit(THREE, 20.0, 0.1), AccelerationLimit(THREE, 200.0, 0.1)])
def test_the_gradient_of_a_limit_is_that_of_finite_differences(constraint: Constraint) -> None:
    shaped = constraint.shaped(Barrier("softplus", gamma=0.1))
    x, h = configurations(THREE, batch=1), 1e-6
    directions = h * torch.eye(x.numel(), dtype=x.dtype).view(-1, *x.shape[1:])
    difference = (shaped.barrier(x + directions) - shaped.barrier(x - directions)) / (2 * h)
    # Slopes are up to 1 / dt^2 = 100: rounding of C, some 1e-13, over h, and truncation h^2 gamma^2 1e6.
    torch.testing.assert_close(shaped.gradient(x).flatten(), difference, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("constraint", [SpeedLimit(ONE, 2.0, 0.1), AccelerationLimit(ONE, 20.0, 0.1)])
def test_a_step_along_the_gradient_brings_a_trajectory_nearer_to_the_limit(constraint: Constraint) -> None:
    x = configurations(ONE)
    violates = constraint.violation(x)
    assert bool(violates.any())
    stepped = x + 1e-6 * constraint.gradient(x)
    assert bool((constraint.barrier(stepped) > constraint.barrier(x))[violates].all())


def test_one_robot_has_all_constraints_but_that_of_avoiding_others() -> None:
    """Clearances by hand at (0.7, -0.2) and 0.1 further along x after a tenth of a second; its radius is 0.1."""
    x = torch.tensor([[[0.7, -0.2], [0.8, -0.2]]], dtype=torch.float64)
    assert ONE.count == 1
    expected = {
        Workspace(ONE): [0.3, 0.2],  # the centre's
        Workspace(ONE, 0.1): [0.2, 0.1],
        ObstacleAvoidance(ONE, [Obstacle(0.7, 0.3, 0.15)]): [0.25, math.hypot(0.1, 0.5) - 0.25],
        SpeedLimit(ONE, 1.5, 0.1): [0.5, 0.5],
    }
    for constraint, clearances in expected.items():
        assert constraint.clearance(x)[0].tolist() == pytest.approx(clearances, abs=1e-7)  # radii are in float32
        assert constraint.gradient(x).shape == x.shape
        assert constraint.swept_clearance(x).item() <= min(clearances) + 1e-7
    with pytest.raises(ValueError, match="one robot: expected two or more that avoid each other"):
        RobotAvoidance(ONE)
    arm = Arms()
    arm.owner = torch.zeros(4, dtype=torch.long)  # however many bodies it has
    with pytest.raises(ValueError, match="one robot"):
        RobotAvoidance(arm)


def test_obstacles_are_one_disc_or_more_for_bodies_in_the_plane() -> None:
    with pytest.raises(ValueError, match=r"^no obstacles: expected one or more to stay clear of$"):
        ObstacleAvoidance(THREE, [])
    with pytest.raises(ValueError, match=r"^obstacles for bodies in 3 dimensions: expected bodies in the plane, as "):
        ObstacleAvoidance(Balls(2, 0.1), OBSTACLES)
