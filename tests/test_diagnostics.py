"""Guidance and solvers measured on fields simple enough to follow by hand."""

import math
from typing import cast

import pytest
import torch

from conflow.flow.network import ResMLP
from conflow.flow.sampler import integrate
from conflow.flow.settings import Solver
from conflow.scene.measures import smoothness
from conflow.scene.tasks.swap import swap
from conflow.training import config
from conflow.training.build import random_stream
from conflow.training.diagnostics import by_evaluations, collisions_by_weight, guidance, taken_back
from conflow.training.model import ConFlow
from conflow.training.module import Training
from tests.papers import SETTINGS, TWO, model_of

STEPS = 10


def model(*arguments: str) -> Training:
    torch.manual_seed(0)
    return model_of(config.load(["preset=smoke", *arguments]), 32, 4)


def constant(velocity: float, *arguments: str) -> ConFlow:
    """A model whose network gives the same velocity to every coordinate, everywhere."""
    flow = model(*arguments)
    torch.nn.init.zeros_(flow.v.outlet.weight)
    torch.nn.init.constant_(flow.v.outlet.bias, velocity)
    return flow


def side_by_side(distance: float, batch: int = 3) -> torch.Tensor:
    """Robots that stand still beside each other on the x-axis."""
    return torch.tensor([distance / 2, 0, -distance / 2, 0]).expand(batch, 32, 4)


@pytest.mark.parametrize("gamma", [10, 25])
def test_without_guidance_a_constant_field_only_moves_the_trajectories(gamma: int) -> None:
    """C(x_0 + t v) at every t, for a velocity v that carries both robots towards the obstacle."""
    flow, x_0 = constant(0.4, f"constraint.gamma={gamma}"), side_by_side(0.2)
    found = guidance(flow, "none", x_0)
    assert found.t.tolist() == pytest.approx([k / STEPS for k in range(STEPS + 1)])
    assert found.ratio.tolist() == [0] * (STEPS + 1)
    assert (found.start_drift, found.end_drift) == (0, 0)
    # The same distance at all 32 waypoints and all times, and clearances of discs of 0.15 to one of 0.1 at (0, 0.5).
    robots = 32 * -math.log1p(math.exp(-gamma * (0.2 - 0.3))) / gamma
    assert found.barriers["robot"].tolist() == pytest.approx([robots] * (STEPS + 1), rel=1e-4)  # float32
    for t, value in zip(found.t.tolist(), found.barriers["object"].tolist(), strict=True):
        gap = min(math.dist((x + 0.4 * t, 0.4 * t), (0, 0.5)) for x in (-0.1, 0.1)) - 0.25
        assert value == pytest.approx(32 * -math.log1p(math.exp(-gamma * gap)) / gamma, rel=1e-4)


class Back(torch.nn.Module):
    """v = -share x / (1 - t), under which a share of any displacement is gone by t = 1, to first order."""

    def __init__(self, share: float) -> None:
        super().__init__()
        self.share = share

    def forward(self, x: torch.Tensor, t: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
        return -self.share * x / (1 - t)[:, None, None]


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("arguments", [(), ("ablation=plus", "source.fit=false")])
def test_what_a_velocity_takes_back_is_its_share_along_every_mode(share: float, arguments: tuple[str, ...]) -> None:
    flow = model(*arguments)
    flow.v = cast(ResMLP, Back(share))
    x_1 = swap(100)
    found = taken_back(flow, flow.source.sample(flow.source.observe(x_1), random_stream("test")), x_1, 0.6)
    assert found.shape == (flow.source.modes.shape[1],)
    # Differences of velocities, in float32.
    torch.testing.assert_close(found, torch.full_like(found, share), atol=1e-3, rtol=0)


def test_the_ratio_is_the_guidance_over_the_velocity() -> None:
    """At t = 0: |grad C| = slope at each robot and waypoint, smoothed by rows of the filter that sum to 1 inside."""
    flow = constant(0.5, "sample.robot_weight=0.7")
    slope = 1 / (1 + math.exp(10 * (0.2 - 0.3)))
    rows = flow.u_c.smoothing.sum(dim=1)
    expected = 0.7 * slope * math.sqrt(2 * float((rows**2).sum())) / (0.5 * math.sqrt(32 * 4))
    assert float(guidance(flow, "robot", side_by_side(0.2)).ratio[0]) == pytest.approx(expected, rel=1e-5)


def test_the_ratio_is_that_of_norms_over_the_whole_batch() -> None:
    """Where half of the batch feels no guidance, the mean square halves."""
    flow = constant(0.5, "sample.robot_weight=1", "constraint.barrier=relu")
    near, far = side_by_side(0.2), side_by_side(2.0)
    both = guidance(flow, "robot", torch.cat([near, far]))
    alone = guidance(flow, "robot", near)
    assert float(both.ratio[0]) == pytest.approx(float(alone.ratio[0]) / math.sqrt(2), rel=1e-5)


def test_the_drift_is_how_far_guidance_moves_start_and_goal() -> None:
    """Two robots on the x-axis part by 2 weight slope per unit of t, smoothed; followed in steps of Euler."""
    flow = constant(0.3, "sample.robot_weight=1")
    d = torch.full((32,), 0.2, dtype=torch.float64)
    S = flow.u_c.smoothing.double()
    for _ in range(STEPS):
        d = d + 2 / STEPS * S @ torch.sigmoid(-10 * (d - 0.3))
    found = guidance(flow, "robot", side_by_side(0.2))
    assert found.start_drift == pytest.approx(float(d[0] - 0.2) / 2, rel=1e-5)  # float32
    assert found.end_drift == pytest.approx(float(d[-1] - 0.2) / 2, rel=1e-5)


@pytest.mark.parametrize("setting", SETTINGS)
def test_guidance_of_weight_0_does_nothing(setting: str) -> None:
    flow = model("sample.robot_weight=0", "sample.obstacle_weight=0")
    found = guidance(flow, setting, swap(20))
    assert float(found.ratio.max()) == 0
    assert (found.start_drift, found.end_drift) == (0, 0)
    assert torch.equal(found.barriers["robot"], guidance(flow, "none", swap(20)).barriers["robot"])


@pytest.mark.parametrize("setting", ["robot", "obstacle"])
def test_collisions_at_a_weight_are_those_of_sampling_with_it(setting: str) -> None:
    x_0 = model().source.sample(swap(200)[:, [0, -1]], random_stream("test", 0))
    weights = [0.0, 0.3, 3.0]
    expected = []
    for weight in weights:
        flow = model(f"sample.{setting}_weight={weight}")
        constraint = flow.judged["robot"] if setting == "robot" else flow.judged["object"]
        expected.append(int(constraint.violation(flow.flow(x_0, setting)).sum()))
    assert collisions_by_weight(model(), setting, x_0, weights) == expected
    assert expected[0] > expected[-1]


@pytest.mark.parametrize(("solver", "steps"), [("euler", [1, 7, 20]), ("midpoint", [1, 3, 10]), ("rk4", [1, 1, 5])])
def test_a_solver_spends_the_evaluations_that_it_was_given(solver: Solver, steps: list[int]) -> None:
    """Counted at the network; rounded down to whole steps, but to no less than one."""
    flow, x_0 = model(), swap(50)
    calls: list[int] = []
    flow.v.register_forward_hook(lambda *_: calls.append(1))
    solved = by_evaluations(flow, solver, x_0, [1, 7, 20])
    assert sum(one.evaluations for one in solved) == len(calls)
    for one, number in zip(solved, steps, strict=True):
        x = integrate(flow.v, x_0, number, solver)
        assert one.collisions == int(flow.judged["robot"].violation(x).sum())
        assert torch.equal(one.smoothness, smoothness(TWO, x))
