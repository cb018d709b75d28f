"""What guidance does along the sampling ODE, what the network takes back, and how weight and solver change results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from conflow.flow.path import interpolate
from conflow.flow.sampler import integrate, states
from conflow.flow.settings import Solver
from conflow.scene.constraint import Constraint
from conflow.scene.measures import endpoint_error, smoothness
from conflow.training.build import NONE, joined
from conflow.training.model import ConFlow, start_and_goal

EVALUATIONS: dict[Solver, int] = {"euler": 1, "midpoint": 2, "rk4": 4}
"""Network evaluations of one step."""
PUSH = 0.25
"""What a correction moves in a tenth of flow time at the paper's weight of 2.5."""


@dataclass(frozen=True)
class GuidanceTrace:
    """One setting along the sampling ODE, at t = 0, 1/steps, ..., 1: tensors (steps + 1,).

    Attributes:
        t: flow time.
        ratio: |g| / |v(x_t, t)| with g what guidance adds to v, lambda u^c(x_t) or that at the predicted end; both the
            norm over the whole batch, i.e. the ratio of root mean squares.
        barriers: by the constraint's name, the mean over the batch of its C(x_t), in workspace units.
        start_drift: distance between the guided and the unguided x_1 of the same x_0 at the start, mean over robots and
            batch, in workspace units.
        end_drift: the same at the goal.
    """

    t: Tensor
    ratio: Tensor
    barriers: Mapping[str, Tensor]
    start_drift: float
    end_drift: float


@dataclass(frozen=True)
class Solved:
    """Trajectories without guidance from one solver at one number of steps.

    Attributes:
        evaluations: network evaluations for one trajectory.
        collisions: how many trajectories violate what training keeps.
        smoothness: of each trajectory, (batch,).
    """

    evaluations: int
    collisions: int
    smoothness: Tensor


@torch.no_grad()
def guidance(model: ConFlow, setting: str, x_0: Tensor, ends: Tensor | None = None) -> GuidanceTrace:
    """Follow a setting's ODE from samples x_0 (batch, T, D) of the source; `ends` as in `ConFlow.field`."""
    steps, solver = model.config.sample.steps, model.config.sample.solver
    field, v = model.field(setting, ends), model.field(NONE, ends)
    t = torch.arange(steps + 1) / steps
    ratio = []
    barriers: dict[str, list[Tensor]] = {name: [] for name in model.judged}
    x = x_0
    for time, x in zip(t, states(field, x_0, steps, solver), strict=True):
        at = time.expand(len(x))
        flow = v(x, at)
        ratio.append((field(x, at) - flow).norm() / flow.norm())
        for name, constraint in model.judged.items():
            barriers[name].append(constraint.barrier(x).mean())
    plain = integrate(v, x_0, steps, solver)
    drift = (float(endpoint_error(model.task.robots, x, plain, waypoint).mean()) for waypoint in (0, -1))
    return GuidanceTrace(t, torch.stack(ratio), {name: torch.stack(one) for name, one in barriers.items()}, *drift)


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


def avoided(model: ConFlow, setting: str) -> Constraint:
    """What a setting is about: the constraints that it guides around, or all that training keeps."""
    guided = model.guided_around(setting)
    return joined([model.judged[name] for name in guided]) if guided else model.trained


def collisions_by_weight(
    model: ConFlow, setting: str, x_0: Tensor, weights: Sequence[float], ends: Tensor | None = None
) -> list[int]:
    """How many of the trajectories from x_0 (batch, T, D) violate what the setting avoids, at each guidance weight."""
    sample = model.config.sample
    of_inference = [
        model.u_c_at_inference[name] for name in model.guided_around(setting) if name in model.u_c_at_inference
    ]
    pushes = of_inference or [model.u_c]
    fields = [model.guided(model.field(NONE, ends), *((u_c, weight) for u_c in pushes)) for weight in weights]
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
        x = integrate(model.field(NONE, ends), x_0, steps, solver)
        solved.append(
            Solved(steps * EVALUATIONS[solver], int(model.trained.violation(x).sum()), smoothness(model.task.robots, x))
        )
    return solved
