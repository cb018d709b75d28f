"""ConFlow as a torch module: Algorithm 1 of the paper, and sampling from what it trained. Needs torch alone."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from operator import add
from typing import cast

import torch
from torch import Tensor, nn

from conflow.errors import ConfigError
from conflow.flow.correction import Correction, descend
from conflow.flow.network import ResMLP, Spectral
from conflow.flow.path import end, guided_path, interpolate, velocity
from conflow.flow.sampler import Field, Push, descended, guided, guided_ahead, in_pieces, integrate
from conflow.flow.settings import Guidance
from conflow.scene.constraint import Constraint
from conflow.scene.robots import Crowd
from conflow.scene.task import Task
from conflow.training.build import (
    MOMENTUM,
    NONE,
    REFINED,
    barrier,
    build_correction,
    build_network,
    build_source,
    descending,
    joined,
    kept,
    labels,
)
from conflow.training.config import Config

ALL = slice(None)


class ConFlow(nn.Module):
    """Constraint-guided flow matching.

    Args:
        config: the experiment.
        task: what is moved, and what it must keep.

    Attributes:
        judged: the task's constraints by name, as samples are measured.
        u_c: the correction of all that training keeps, with its margin.
    """

    def __init__(self, config: Config, task: Task) -> None:
        super().__init__()
        self.config, self.task = config, task
        self.T, self.D = task.T, task.robots.D
        shape, margin = barrier(config), config.correction.margin
        self.source = build_source(config.source, self.T)
        self.judged = cast(
            Mapping[str, Constraint], nn.ModuleDict({name: one.shaped(shape) for name, one in task.judged().items()})
        )
        self.v = build_network(config.network, self.source, task, labels(config, task))
        self.v.bf16 = config.train.precision == "bf16"
        self.u_c = build_correction(config.correction, kept(config, task), self.source)
        self.descending = descending(config, task, self.source)
        self.u_c_at_inference = cast(
            Mapping[str, Correction],
            nn.ModuleDict(
                {
                    name: build_correction(config.correction, one.shaped(shape, margin), self.source)
                    for name, one in task.constraints_at_inference().items()
                }
            ),
        )

    def of_numbers(self, D: int) -> "ConFlow":
        """The same model for configurations of D numbers, such as of more robots of a crowd: its weights, shared.

        It is this one where its robots are no crowd, or where its network is a ResMLP, which has layers for D alone.
        """
        if D == self.D or not isinstance(self.task.robots, Crowd) or isinstance(self.v, ResMLP):
            return self
        return self.on(self.task.of_numbers(D))

    def on(self, task: Task) -> "ConFlow":
        """The same model for another task of a crowd, such as in another map: its weights, shared.

        Raises:
            ConfigError: its network has layers for another number of robots alone.
        """
        if isinstance(self.v, ResMLP) and task.robots.D != self.D:
            expected = f"expected {self.task.robots.count}, for which alone this network has layers"
            raise ConfigError(f"task.robots={task.robots.count}: {expected}; ABLATION=plus has one for any number")
        with torch.random.fork_rng(devices=[]):  # a new network draws weights, which are not kept
            made = ConFlow(self.config, task)
        made.v.load_state_dict(self.v.state_dict(), assign=True)
        return made.eval()

    @property
    def device(self) -> torch.device:
        """Where it is."""
        return self.source.sampling_map.device

    @property
    def settings(self) -> Sequence[str]:
        """Under which it is sampled: without guidance, and the task's."""
        return (NONE, *self.task.settings(), *([REFINED] if self.config.sample.descent else []))

    @property
    def trained(self) -> Constraint:
        """All that training keeps, as samples are measured."""
        return joined([self.judged[name] for name in self.task.constraints()])

    def fit(self, x_1: Tensor) -> None:
        """What is known of the demonstrations x_1 (N, T, D) before training."""
        if isinstance(self.v, Spectral):
            self.v.fit(x_1)

    def loss(self, x_1: Tensor, M: Tensor, noise: torch.Generator, rows: slice = ALL) -> Tensor:
        """L_CG (Eq. cg_loss) for demonstrations x_1 (batch, T, D) and their violations M (batch,): Algorithm 1.

        Of some rows alone it is the mean over these, with the x_0 and t that they have in the whole batch. It is a mean
        over all rows, corrected or not, so the mean over parts of equal size is the whole's, and so is its gradient.
        """
        x_0 = self.source.sample(self.source.observe(x_1), noise)
        t = torch.rand(len(x_1), device=x_1.device, generator=noise)
        x_0, x_1, t, M = x_0[rows], x_1[rows], t[rows], M[rows]
        lambda_c, ends = self.config.correction.lambda_c, start_and_goal(x_1)
        M = M if self.config.correction.mask == "violates" else ~M
        if self.config.correction.path == "guided":
            x_t, u_t = guided_path(x_0, x_1, t, self.u_c, lambda_c * M)
            return self.distance(self.v(x_t, t, ends), u_t)
        x_t = interpolate(x_0, x_1, t)
        v = self.v(x_t, t, ends)
        if self.config.correction.at == "end":
            # The barrier is its own mask: nothing to correct where the predicted end is feasible.
            u_c = (t**self.config.correction.ramp)[:, None, None] * self.u_c(end(x_t, v.detach(), t))
        else:
            u_c = M[:, None, None] * self.u_c(x_t)
        return self.distance(v, velocity(x_0, x_1) + lambda_c * u_c)

    def distance(self, v: Tensor, u: Tensor) -> Tensor:
        """|v - u|^2 of velocities (batch, T, D), the mean over batch, waypoints and dimensions, or over modes."""
        difference = v - u
        if self.config.train.norm == "modes":
            assert isinstance(self.v, Spectral)  # the config was checked
            difference = self.v.balanced(difference)
        return difference.square().mean()

    def guided_around(self, setting: str) -> Sequence[str]:
        """The names of the constraints that a setting guides around."""
        if setting == REFINED:
            return tuple(self.task.constraints())
        return () if setting == NONE else self.task.settings()[setting]

    def required(self, setting: str) -> Constraint:
        """All that trajectories of a setting must keep: what appears at inference is there in its settings alone."""
        of_inference = [self.judged[name] for name in self.guided_around(setting) if name in self.u_c_at_inference]
        return joined([*(self.judged[name] for name in self.task.constraints()), *of_inference])

    def field(self, setting: str, ends: Tensor | None = None) -> Field:
        """The velocity field of a setting, for starts and goals (batch, 2, D) where the network sees them."""
        sample, v = self.config.sample, partial(self.v, ends=ends)
        guided = self.guided_around(setting)
        if not guided:
            return v
        weighted = [
            (self.u_c_at_inference[name], sample.obstacle_weight) for name in guided if name in self.u_c_at_inference
        ]
        # What descent moves it puts somewhere for good, so there it has to keep everything at once.
        if sample.guidance == "descent" or len(weighted) < len(guided):
            weighted.insert(0, (self.u_c, sample.robot_weight))
        return self.guided(v, *weighted)

    def guided(self, v: Field, *weighted: tuple[Correction, float]) -> Field:
        """A field guided by corrections u^c with their weights lambda, in the way that `sample.guidance` says."""

        def push(x: Tensor) -> Tensor:
            return reduce(add, (weight * u_c(x) for u_c, weight in weighted))

        sample = self.config.sample
        ways: dict[Guidance, Callable[[Field, Push], Field]] = {
            "point": guided,
            "end": guided_ahead,
            "descent": partial(descended, steps=sample.guidance_steps),
        }
        return ways[sample.guidance](v, push)

    def sample(self, x_1: Tensor, setting: str = NONE, noise: torch.Generator | None = None) -> Tensor:
        """Trajectories from where each x_1 starts to where it ends, both (batch, T, D)."""
        return self.flow(self.source.sample(self.source.observe(x_1), noise), setting, start_and_goal(x_1))

    def flow(self, x_0: Tensor, setting: str = NONE, ends: Tensor | None = None) -> Tensor:
        """Where the ODE of `field` takes samples x_0 of the source, (batch, T, D)."""

        def arrive(x_0: Tensor, ends: Tensor | None = None) -> Tensor:
            x = integrate(self.field(setting, ends), x_0, self.config.sample.steps, self.config.sample.solver)
            return descend(x, self.descending, self.config.sample.descent, MOMENTUM) if setting == REFINED else x

        return in_pieces(arrive, x_0) if ends is None else in_pieces(arrive, x_0, ends)


def start_and_goal(x: Tensor) -> Tensor:
    """The first and the last waypoint of trajectories (batch, T, D), (batch, 2, D)."""
    return x[:, [0, -1]]
