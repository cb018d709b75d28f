"""What guidance does along the sampling ODE, what the network takes back, and how weight and solver change results."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from conflow.flow.path import interpolate
from conflow.flow.sampler import Solver, integrate, states
from conflow.scene.constraint import Constraint
from conflow.training.metrics import endpoint_error, smoothness
from conflow.training.module import ConFlow, Setting, start_and_goal

EVALUATIONS: dict[Solver, int] = {"euler": 1, "midpoint": 2, "rk4": 4}
"""Network evaluations of one step."""
PUSH = 0.25
"""What a correction moves in a tenth of flow time at the paper's weight of 2.5."""


@dataclass(frozen=True)
class Guidance:
    """One setting along the sampling ODE, at t = 0, 1/steps, ..., 1: tensors (steps + 1,).

    Attributes:
        t: flow time.
        ratio: |g| / |v(x_t, t)| with g what guidance adds to v, lambda u^c(x_t) or that at the predicted end; both the
            norm over the whole batch, i.e. the ratio of root mean squares.
        robot_barrier: mean over the batch of the robots' barrier C(x_t), in workspace units.
        obstacle_barrier: that of the obstacle's barrier.
        start_drift: distance between the guided and the unguided x_1 of the same x_0 at the start, mean over robots and
            batch, in workspace units.
        end_drift: the same at the goal.
    """

    t: Tensor
    ratio: Tensor
    robot_barrier: Tensor
    obstacle_barrier: Tensor
    start_drift: float
    end_drift: float


@dataclass(frozen=True)
class Solved:
    """Trajectories without guidance from one solver at one number of steps.

    Attributes:
        evaluations: network evaluations for one trajectory.
        collisions: how many trajectories violate the robots' constraint.
        smoothness: of each trajectory, (batch,).
    """

    evaluations: int
    collisions: int
    smoothness: Tensor


@torch.no_grad()
def guidance(model: ConFlow, setting: Setting, x_0: Tensor, ends: Tensor | None = None) -> Guidance:
    """Follow a setting's ODE from samples x_0 (batch, T, D) of the source; `ends` as in `ConFlow.field`."""
    steps, solver = model.config.sample.steps, model.config.sample.solver
    field, v = model.field(setting, ends), model.field("none", ends)
    t = torch.arange(steps + 1) / steps
    ratio, robot_barrier, obstacle_barrier = [], [], []
    x = x_0
    for time, x in zip(t, states(field, x_0, steps, solver), strict=True):
        at = time.expand(len(x))
        flow = v(x, at)
        ratio.append((field(x, at) - flow).norm() / flow.norm())
        robot_barrier.append(model.robots.barrier(x).mean())
        obstacle_barrier.append(model.obstacle.barrier(x).mean())
    plain = integrate(v, x_0, steps, solver)
    start_drift, end_drift = (float(endpoint_error(x, plain, waypoint).mean()) for waypoint in (0, -1))
    return Guidance(
        t, torch.stack(ratio), torch.stack(robot_barrier), torch.stack(obstacle_barrier), start_drift, end_drift
    )


@torch.no_grad()
def taken_back(model: ConFlow, x_0: Tensor, x_1: Tensor, t: float) -> Tensor:
    """How much of a push along grad C the velocity takes back by t = 1, in each mode of the source, (m,).

    -(1 - t) <v(x_t + d) - v(x_t), d> / |d|^2 over the batch, with d = 0.25 e_k e_k^T grad C(x_t) along the eigenvector
    e_k of Sigma, and x_t between samples x_0 of the source and demonstrations x_1, both (batch, T, D). 1 where v would
    undo d by t = 1, as the exact minimiser does along modes in which demonstrations hardly differ; 0 where d stays, as
    with a network that never saw x_t + d.
    """
    time, ends = torch.full((len(x_1),), t), start_and_goal(x_1)
    x_t = interpolate(x_0, x_1, time)
    v, grad_C = model.v(x_t, time, ends), model.u_c.constraint.gradient(x_t)
    shares = []
    for e_k in model.source.modes.T.to(x_t.dtype)[:, :, None]:
        d = PUSH * e_k @ (e_k.mT @ grad_C)
        shares.append(-(1 - t) * ((model.v(x_t + d, time, ends) - v) * d).sum() / d.square().sum())
    return torch.stack(shares)


def avoided(model: ConFlow, setting: Setting) -> Constraint:
    """What a setting is about: the obstacle, or else the robots."""
    return model.obstacle if setting == "obstacle" else model.robots


def collisions_by_weight(
    model: ConFlow, setting: Setting, x_0: Tensor, weights: Sequence[float], ends: Tensor | None = None
) -> list[int]:
    """How many of the trajectories from x_0 (batch, T, D) hit what the setting avoids, at each guidance weight."""
    sample = model.config.sample
    u_c = model.u_c_obstacle if setting == "obstacle" else model.u_c
    fields = [model.guided(model.field("none", ends), (u_c, weight)) for weight in weights]
    return [
        int(avoided(model, setting).violation(integrate(field, x_0, sample.steps, sample.solver)).sum())
        for field in fields
    ]


def by_evaluations(
    model: ConFlow, solver: Solver, x_0: Tensor, evaluations: Sequence[int], ends: Tensor | None = None
) -> list[Solved]:
    """Trajectories from x_0 (batch, T, D) without guidance, for each number of network evaluations.

    Numbers that are no multiple of what one step of the solver takes are rounded down to one.
    """
    solved = []
    for number in evaluations:
        steps = max(1, number // EVALUATIONS[solver])
        x = integrate(model.field("none", ends), x_0, steps, solver)
        solved.append(Solved(steps * EVALUATIONS[solver], int(model.robots.violation(x).sum()), smoothness(x)))
    return solved
