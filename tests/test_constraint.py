"""Clearance, barrier, gradient and violation, against autograd, finite differences and trajectories made by hand."""

import math
from collections.abc import Callable
from typing import get_args

import pytest
import torch
from torch import Tensor

from conflow.scene.constraint import Barrier, Constraint, Sum, Workspace
from conflow.scene.robots import Discs
from conflow.scene.settings import BarrierShape, Obstacle, Reduction
from tests.papers import keep_apart, keep_clear

OBSTACLES = [Obstacle(0.0, 0.5, 0.1), Obstacle(-0.4, 0.0, 0.2), Obstacle(0.3, -0.3, 0.05)]
TWO, THREE = Discs(2), Discs(3)

CONSTRAINTS: dict[str, tuple[Discs, Callable[[Barrier], Constraint]]] = {
    "two robots": (TWO, lambda barrier: keep_apart(2, 0.3, barrier)),
    "three robots": (THREE, lambda barrier: keep_apart(3, 0.3, barrier)),
    "two robots, one obstacle": (TWO, lambda barrier: keep_clear(2, OBSTACLES[:1], 0.15, barrier)),
    "three robots, three obstacles": (THREE, lambda barrier: keep_clear(3, OBSTACLES, 0.15, barrier)),
    # With walls at 2, so that some of `trajectories` stay within.
    "three robots and walls": (THREE, lambda barrier: Workspace(THREE, -1.0).shaped(barrier)),
    "robots and obstacles": (
        THREE,
        lambda barrier: Sum([keep_apart(3, 0.3, barrier), keep_clear(3, OBSTACLES, 0.15, barrier)]),
    ),
}

constraints = pytest.mark.parametrize(("robots", "build"), CONSTRAINTS.values(), ids=CONSTRAINTS)
shapes = pytest.mark.parametrize("shape", get_args(BarrierShape))
reductions = pytest.mark.parametrize("reduction", get_args(Reduction))


def trajectories(robots: Discs = TWO, batch: int = 64, T: int = 6) -> Tensor:
    """Trajectories about the origin, some in collision and some not."""
    generator = torch.Generator().manual_seed(0)
    return 0.8 * torch.randn(batch, T, 2 * robots.count, dtype=torch.float64, generator=generator)


def apart(*distances: float) -> Tensor:
    """One trajectory of two robots on the x-axis, at these distances from each other."""
    d = torch.tensor(distances, dtype=torch.float64)
    return torch.stack([d / 2, 0 * d, -d / 2, 0 * d], dim=1)[None]


@constraints
@shapes
@reductions
def test_the_closed_form_gradient_is_autograds(
    robots: Discs, build: Callable[[Barrier], Constraint], shape: BarrierShape, reduction: Reduction
) -> None:
    """grad C equals the derivative of `barrier`, trajectory by trajectory, in and out of collision."""
    constraint = build(Barrier(shape, reduction))
    x = trajectories(robots).requires_grad_()
    violates = constraint.violation(x.detach())
    assert 0 < int(violates.sum()) < len(x)
    (expected,) = torch.autograd.grad(constraint.barrier(x).sum(), x)
    gradient = constraint.gradient(x.detach())
    assert bool((gradient[violates] != 0).flatten(1).any(dim=1).all())
    # The clearance holds the radius, which is added again to get the distance: some rounding of float64.
    torch.testing.assert_close(gradient, expected, rtol=1e-12, atol=1e-12)


@constraints
@reductions
def test_the_gradient_is_the_limit_of_finite_differences(
    robots: Discs, build: Callable[[Barrier], Constraint], reduction: Reduction
) -> None:
    """Central differences of C over every coordinate of a trajectory."""
    constraint = build(Barrier("softplus", reduction))
    x, h = trajectories(robots, batch=1), 1e-6
    directions = h * torch.eye(x.numel(), dtype=x.dtype).view(-1, *x.shape[1:])
    difference = (constraint.barrier(x + directions) - constraint.barrier(x - directions)) / (2 * h)
    # Truncation h^2 gamma^2 = 1e-10, and as much of rounding.
    torch.testing.assert_close(constraint.gradient(x).flatten(), difference, rtol=0, atol=1e-8)


@reductions
def test_the_barrier_of_a_trajectory_made_by_hand(reduction: Reduction) -> None:
    """C written out for distances 0.5, 0.15 and 0.3 with r = 0.25 and gamma = 10."""
    distances = (0.5, 0.15, 0.3)
    counted = (min(distances),) if reduction == "closest" else distances
    share = 1 / 3 if reduction == "mean" else 1
    softplus = sum(-math.log(1 + math.exp(-10 * (d - 0.25))) / 10 for d in counted)
    relu = sum(min(d - 0.25, 0) for d in counted)
    shapes: tuple[tuple[BarrierShape, float], ...] = (("softplus", share * softplus), ("relu", share * relu))
    for shape, expected in shapes:
        C = keep_apart(2, 0.25, Barrier(shape, reduction, gamma=10)).barrier(apart(*distances))
        assert C.tolist() == pytest.approx([expected], abs=1e-14)  # float64 rounding


@reductions
def test_the_gradient_of_a_trajectory_made_by_hand(reduction: Reduction) -> None:
    """The robots are pushed apart along the line between them, by the logistic function of -gamma (d - r)."""
    distances = (0.5, 0.15, 0.3)
    share = 1 / 3 if reduction == "mean" else 1
    gradient = keep_apart(2, 0.25, Barrier("softplus", reduction, gamma=10)).gradient(apart(*distances))
    for d, (x_1, y_1, x_2, y_2) in zip(distances, gradient[0].tolist(), strict=True):
        slope = share / (1 + math.exp(10 * (d - 0.25))) if reduction != "closest" or d == 0.15 else 0
        assert (x_1, y_1, x_2, y_2) == pytest.approx((slope, 0, -slope, 0), abs=1e-14)  # float64 rounding


@reductions
@pytest.mark.parametrize("gamma", [1.0, 10.0, 1e3, 1e6])
def test_softplus_stays_below_relu_and_approaches_it(reduction: Reduction, gamma: float) -> None:
    """0 <= relu - softplus <= log 2 / gamma at each waypoint that counts."""
    x = trajectories()
    relu = keep_apart(2, barrier=Barrier("relu", reduction)).barrier(x)
    softplus = keep_apart(2, barrier=Barrier("softplus", reduction, gamma)).barrier(x)
    counted = x.shape[1] if reduction == "sum" else 1
    gap = relu - softplus
    assert bool((gap >= 0).all())
    assert bool((gap <= counted * math.log(2) / gamma + 1e-14).all())  # float64 rounding
    if gamma < 1e6:  # there hardly a waypoint is near enough to the threshold for a bit of difference
        assert float(gap.max()) > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("distance", [0.0, 1e-42, 1e-30, 1e-20, 1e-9, 1e-8, 1e-7, 1e-3])
@pytest.mark.parametrize(
    ("constraint", "other"),
    [(keep_apart(2, 0.3), 0.0), (keep_clear(2, [Obstacle(0.0, 0.0, 0.15)], 0.15), 1.0)],
    ids=["robots", "obstacle"],
)
def test_the_push_of_bodies_that_all_but_coincide_stays_bounded(
    constraint: Constraint, other: float, distance: float, dtype: torch.dtype
) -> None:
    """No body is pushed harder than with slope 1, and from 1e-7 on with the very slope of the barrier."""
    x = torch.tensor([[[distance, 0, other, other]]], dtype=dtype)
    gradient = constraint.gradient(x)
    assert bool(gradient.isfinite().all())
    push = math.hypot(*gradient[0, 0, :2].tolist())
    assert push <= 1
    if distance >= 1e-7:
        assert push == pytest.approx(1 / (1 + math.exp(10 * (distance - 0.3))), rel=1e-6)  # float32 rounding


def test_a_step_along_the_gradient_opens_the_clearance_by_twice_the_slope() -> None:
    """Two robots that go eta grad C each are 2 eta dC/dc further apart at every waypoint."""
    constraint = keep_apart(2)
    x, eta = trajectories(), 0.01
    before = constraint.clearance(x)
    opened = constraint.clearance(x + eta * constraint.gradient(x)) - before
    torch.testing.assert_close(opened, 2 * eta * Barrier().slope(before), rtol=0, atol=1e-12)  # float64 rounding


@constraints
@shapes
@reductions
def test_a_small_step_along_the_gradient_improves_a_colliding_trajectory(
    robots: Discs, build: Callable[[Barrier], Constraint], shape: BarrierShape, reduction: Reduction
) -> None:
    """C grows by eta |grad C|^2 to first order."""
    constraint = build(Barrier(shape, reduction))
    x, eta = trajectories(robots), 1e-8
    x = x[constraint.violation(x)]
    g = constraint.gradient(x)
    growth = constraint.barrier(x + eta * g) - constraint.barrier(x)
    # The second order in eta, with curvatures gamma and 1 / |w|, and as much of rounding; where bodies hardly overlap
    # the slope of the square is next to nothing, and rounding of the clearance is seen.
    atol = 1e-18 if shape == "square" else 0.0
    torch.testing.assert_close(growth, eta * (g**2).sum(dim=(1, 2)), rtol=1e-5, atol=atol)


@pytest.mark.parametrize("waypoint", [0, 2, 4])
@pytest.mark.parametrize(("gap", "violates"), [(-(2.0**-20), True), (0.0, False), (2.0**-20, False)])
@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 2)])
def test_robots_collide_where_they_are_nearer_than_the_radius(
    pair: tuple[int, int], gap: float, violates: bool, waypoint: int
) -> None:
    """One pair at one waypoint inside the radius makes M true; touching does not. The numbers are exact in float32."""
    x = torch.zeros(1, 5, 3, 2)
    x[0, :, :, 1] = torch.tensor([-1.0, 0.0, 1.0])
    x[0, waypoint, pair[1]] = x[0, waypoint, pair[0]] + torch.tensor([0.25 + gap, 0.0])
    constraint = keep_apart(3, 0.25)
    assert constraint.violation(x.flatten(2)).tolist() == [violates]
    assert constraint.clearance(x.flatten(2)).amin() == gap


@pytest.mark.parametrize("robot", [0, 1])
@pytest.mark.parametrize(("gap", "violates"), [(-(2.0**-20), True), (0.0, False), (2.0**-20, False)])
@pytest.mark.parametrize("obstacle", [0, 1])
def test_a_robot_touches_an_obstacle_at_the_sum_of_their_radii(
    obstacle: int, gap: float, violates: bool, robot: int
) -> None:
    """Discs of radius 1/8 and 1/16 or 1/4, exact in float32, meet at the distance 3/16 or 3/8 of their centres."""
    obstacles = [Obstacle(0.0, 0.5, 1 / 16), Obstacle(0.0, -0.5, 1 / 4)]
    x = torch.full((1, 5, 2, 2), 2.0)
    centre = torch.tensor([obstacles[obstacle].x, obstacles[obstacle].y])
    x[0, 3, robot] = centre + torch.tensor([1 / 8 + obstacles[obstacle].radius + gap, 0.0])
    constraint = keep_clear(2, obstacles, robot_radius=1 / 8)
    assert constraint.violation(x.flatten(2)).tolist() == [violates]
    assert constraint.clearance(x.flatten(2)).amin() == gap


@constraints
@reductions
def test_the_clearance_is_that_of_a_loop_over_all_bodies(
    robots: Discs, build: Callable[[Barrier], Constraint], reduction: Reduction
) -> None:
    """The smallest of all gaps, computed one by one, whatever the barrier."""
    constraint = build(Barrier(reduction=reduction))
    x = trajectories(robots, batch=2)
    kinds = [type(term).__name__ for term in constraint.modules()]
    obstacles = OBSTACLES[: robots.count if robots.count == 3 else 1] if "ObstacleAvoidance" in kinds else []
    for row, clearances in zip(x, constraint.clearance(x), strict=True):
        for q, clearance in zip(row.view(-1, robots.count, 2).tolist(), clearances, strict=True):
            gaps = [math.dist(p, (o.x, o.y)) - o.radius - 0.15 for p in q for o in obstacles]
            if "RobotAvoidance" in kinds:
                gaps += [math.dist(q[i], q[j]) - 0.3 for i in range(len(q)) for j in range(i)]
            if "Workspace" in kinds:
                gaps += [2 - abs(coordinate) for p in q for coordinate in p]
            assert float(clearance) == pytest.approx(min(gaps), abs=1e-7)  # radii are kept in float32


@shapes
@reductions
def test_which_robot_is_which_does_not_matter(shape: BarrierShape, reduction: Reduction) -> None:
    """Swapping two of three robots leaves C and c as they are and swaps the gradient."""
    constraint = keep_apart(3, barrier=Barrier(shape, reduction))
    x, swapped = trajectories(THREE), [2, 3, 0, 1, 4, 5]
    torch.testing.assert_close(constraint.barrier(x[..., swapped]), constraint.barrier(x), rtol=0, atol=1e-14)
    torch.testing.assert_close(constraint.clearance(x[..., swapped]), constraint.clearance(x), rtol=0, atol=0)
    torch.testing.assert_close(
        constraint.gradient(x[..., swapped]), constraint.gradient(x)[..., swapped], rtol=0, atol=1e-14
    )


@shapes
@reductions
def test_robot_avoidance_knows_no_place_and_no_direction(shape: BarrierShape, reduction: Reduction) -> None:
    """Moving and turning all robots together leaves C as it is and turns the gradient along."""
    constraint = keep_apart(3, barrier=Barrier(shape, reduction))
    cos, sin = math.cos(0.7), math.sin(0.7)
    turn = torch.block_diag(*[torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)] * 3)
    x = trajectories(THREE)
    moved = x @ turn.mT + torch.tensor([0.3, -0.2] * 3, dtype=torch.float64)
    # float64 rounding, through distances of 1e-2 and more
    torch.testing.assert_close(constraint.barrier(moved), constraint.barrier(x), rtol=0, atol=1e-12)
    torch.testing.assert_close(constraint.gradient(moved), constraint.gradient(x) @ turn.mT, rtol=0, atol=1e-12)


def test_the_workspace_keeps_every_robot_from_every_wall() -> None:
    """The clearance is the distance to the nearest wall less the margin; in a corner both walls push, inwards."""
    corner = torch.tensor([[[0.95, -0.97, 0.0, 0.5]]], dtype=torch.float64)
    walls = Workspace(TWO, 0.1).shaped(Barrier("relu"))
    torch.testing.assert_close(walls.clearance(corner), torch.tensor([[-0.07]], dtype=torch.float64))
    assert walls.gradient(corner).tolist() == [[[-1, 1, 0, 0]]]
    assert not bool(Workspace(TWO).violation(corner).any())
    assert bool(Workspace(TWO).violation(corner + 0.06).all())


def test_a_sum_adds_barriers_and_violates_where_any_term_does() -> None:
    """C and grad C add up, the clearance is the smallest, M is 'or'; a sum is again a constraint."""
    robots, obstacle = keep_apart(2, 0.5), keep_clear(2, OBSTACLES, 0.1)
    x = trajectories(T=2)
    both = Sum([robots, obstacle])
    a, b = robots.violation(x), obstacle.violation(x)
    assert len(torch.stack([a, b], dim=1).unique(dim=0)) == 4  # every combination occurs
    assert torch.equal(both.violation(x), a | b)
    assert torch.equal(both.clearance(x), torch.minimum(robots.clearance(x), obstacle.clearance(x)))
    assert torch.equal(both.barrier(x), robots.barrier(x) + obstacle.barrier(x))
    assert torch.equal(both.gradient(x), robots.gradient(x) + obstacle.gradient(x))
    # Another order of addition rounds differently.
    torch.testing.assert_close(Sum([both, robots]).gradient(x), 2 * robots.gradient(x) + obstacle.gradient(x))


def test_a_trajectory_that_is_not_finite_is_not_called_feasible() -> None:
    """M is true where the clearance is NaN: a sampler that diverged does not count as free of collisions."""
    x = apart(1.0, 1.0, 1.0)
    x[0, 1] = math.nan
    assert keep_apart(2).violation(x).tolist() == [True]


@constraints
def test_the_swept_clearance_is_the_smallest_of_many_moments(
    robots: Discs, build: Callable[[Barrier], Constraint]
) -> None:
    """All bodies go straight from waypoint to waypoint, seen at 2001 moments of each segment."""
    constraint = build(Barrier())
    x = trajectories(robots, batch=16)
    tau = torch.linspace(0, 1, 2001, dtype=x.dtype)[:, None]
    moments = torch.lerp(x[:, :-1, None], x[:, 1:, None], tau)
    dense = constraint.clearance(moments.flatten(0, 1).flatten(0, 1)[:, None]).view(16, -1, len(tau)).amin(dim=2)
    swept = constraint.swept_clearance(x)
    assert bool((swept <= dense + 1e-12).all())
    # Between two moments a separation changes by its length over 2000 at most: here less than 6 / 2000 / 2.
    torch.testing.assert_close(swept, dense, rtol=0, atol=1.5e-3)


@constraints
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_swept_clearance_is_never_above_that_of_the_waypoints(
    robots: Discs, build: Callable[[Barrier], Constraint], dtype: torch.dtype
) -> None:
    """To the last bit, so what collides at a waypoint collides on the way too; often it is that of an end."""
    constraint = build(Barrier())
    x = trajectories(robots, batch=1000).to(dtype)
    clearance = constraint.clearance(x)
    ends = torch.minimum(clearance[:, :-1], clearance[:, 1:])
    swept = constraint.swept_clearance(x)
    assert swept.shape == (1000, x.shape[1] - 1)
    assert bool((swept <= ends).all())
    assert int((swept == ends).sum()) > 0
    assert bool((swept < ends).any()) != isinstance(constraint, Workspace)  # a square is convex


def test_robots_that_pass_through_each_other_between_waypoints_are_found() -> None:
    """They swap places in one step, and at a distance of 1/4 they pass; neither shows at the waypoints."""
    through = torch.tensor([[[-1.0, 0, 1, 0], [1, 0, -1, 0]]])
    past = torch.tensor([[[-1.0, 0, 1, 0.25], [1, 0, -1, 0.25]]])
    x = torch.cat([through, past])
    constraint = keep_apart(2, 0.5)
    assert constraint.violation(x).tolist() == [False, False]
    assert constraint.swept_clearance(x).tolist() == [[-0.5], [-0.25]]


def test_robots_that_only_part_or_stand_still_come_no_closer_on_the_way() -> None:
    """Where there is no closer approach in between, the swept clearance is the smaller one of the ends."""
    assert keep_apart(2, 0.25).swept_clearance(apart(1, 2, 2, 0.5)).tolist() == [[0.75, 1.75, 0.25]]
    standing = torch.zeros(1, 2, 4, dtype=torch.float64)
    assert keep_apart(2, 0.25).swept_clearance(standing).tolist() == [[-0.25]]


def test_a_swept_clearance_that_is_not_a_number_stays_so() -> None:
    x = apart(1.0, 1.0, 1.0)
    x[0, 2] = math.nan
    assert keep_apart(2, 0.25).swept_clearance(x)[0].isnan().tolist() == [False, True]


def test_no_trajectories_have_no_clearances() -> None:
    """Such as the negatives of demonstrations that are all feasible."""
    constraint = keep_apart(2)
    x = trajectories()[:0]
    assert constraint.clearance(x).shape == constraint.swept_clearance(x).shape[:1] + x.shape[1:2]
    assert constraint.gradient(x).shape == x.shape
    assert constraint.violation(x).shape == (0,)
