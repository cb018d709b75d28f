"""The numbers behind the pictures of `make explain`: closed forms and exact flows, without a run.

Everything is of the swaps that the settings generate, in workspace units, and of one robot's y where one number is
shown. `closed_form` has the expectations; `figures.explain` draws.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from conflow.flow.correction import Correction, covariant, gaussian_filter
from conflow.flow.sampler import Field, states
from conflow.flow.source import Source
from conflow.scene.constraint import Constraint
from conflow.scene.tasks.swap import swap
from conflow.training import config
from conflow.training.build import build_source, build_task, fitted, labels, random_stream
from conflow.training.closed_form import coordinates, expected, minimiser, posterior, whitened
from conflow.training.config import Config

PAIRS = 2000
"""Demonstrations, each with its own x_0, over which expectations in the space of trajectories are taken."""
GAPS, PARTICLES, GAP_STEPS = 500, 1000, 100
"""Of the flow of gaps: quantiles of the demonstrations, quantiles of the source, and steps."""
SAMPLES, SAMPLE_STEPS = 512, 100
"""Of the flow of trajectories: samples and steps."""
TIMES = 25
"""Of the flow, evenly from 0 on, at which pairs are looked at."""
CLEARED = 0.9
"""The share of D- that counts as most of it."""
FILTER, CLOSEST, COVARIANT = "filter", "closest", "covariant"
"""Corrections: with the paper's filter, with that filter at the closest approach alone, and along the covariance."""
ROW_SUM, PEAKED, SIGMA = "Sigma / largest row sum", "Sigma / largest entry", "Sigma"
"""Scales of the source's covariance, of which the first is `covariant`'s."""


def demonstrations(settings: Config) -> Tensor:
    """The swaps that the settings describe, D+ and D-, (N, T, D)."""
    data = settings.data
    return swap(data.num, data.horizon, data.amplitudes, data.jitter, data.seed)


def label(settings: Config) -> Constraint:
    """What labels the swaps that the settings describe."""
    return labels(settings, build_task(settings))


def paper_filter(settings: Config, T: int) -> Tensor:
    """The Gaussian filter of these settings, (T, T), under which the gradient counts as zero beyond the ends."""
    return gaussian_filter(T, settings.correction.sigma, settings.correction.width)


def kept() -> int:
    """How many leading modes of the source the spectral network works in."""
    modes = config.load(["ablation=spectral"]).source.modes
    assert modes is not None
    return modes


class Gap(NamedTuple):
    """Flow matching of g = y1 - y2 at the middle waypoint, the signed gap with which the robots pass each other.

    Attributes:
        g_1: the demonstrations' gaps, (N,).
        sd: standard deviation of the source's gap, which is Gaussian about 0.
        u_c: the correction at one waypoint, without smoothing.
        radius: the gap at which robots touch.
    """

    g_1: Tensor
    sd: float
    u_c: Correction
    radius: float

    @classmethod
    def of(cls, settings: Config) -> "Gap":
        """Some quantiles of the demonstrations' gaps, which stand for all, and the source's gap."""
        x = demonstrations(settings)
        middle = x.shape[1] // 2
        g_1 = (x[:, middle, 1] - x[:, middle, 3]).quantile(_middles(GAPS))
        # The difference of two independent robots.
        variance = 2 * build_source(settings.source, x.shape[1]).covariance[middle, middle]
        u_c = Correction(label(settings), torch.eye(1))
        return cls(g_1, float(variance.sqrt()), u_c, settings.constraint.radius)

    def field(self, weight: float) -> Field:
        """E[x_1 - x_0 | x_t] + weight E[M | x_t] u^c(x_t) for gaps x (batch, 1, 1) and t (batch,), all alike."""
        known = torch.stack([self.g_1, self.violates(self.g_1).float()], dim=1)

        def v(x: Tensor, t: Tensor) -> Tensor:
            g, now = x[:, :, 0], float(t[0])
            end, M = (posterior(g / self.sd, self.g_1[:, None] / self.sd, now) @ known).split(1, dim=1)
            # E[x_1 - x_0 | x_t] leads straight to E[x_1 | x_t].
            return ((end - g) / (1 - now) + weight * M * self.push(g))[:, :, None]

        return v

    def paths(self, weight: float) -> Tensor:
        """Where the field takes quantiles of the source, (GAP_STEPS + 1, PARTICLES)."""
        g_0 = self.sd * torch.special.ndtri(_middles(PARTICLES))
        return torch.stack([g[:, 0, 0] for g in states(self.field(weight), g_0[:, None, None], GAP_STEPS)])

    def velocities(self, t: Tensor, g: Tensor, weight: float) -> Tensor:
        """The field at times t (n,) and gaps g (m,), (m, n), in workspace units per t."""
        v = self.field(weight)
        return torch.cat([v(g[:, None, None], one.expand(len(g)))[:, :, 0] for one in t], dim=1)

    def push(self, g: Tensor) -> Tensor:
        """What the correction adds to dg/dt at gaps g, both (batch, 1): both robots move."""
        u_c = self.u_c(_beside(g[:, 0]))
        return u_c[..., 1] - u_c[..., 3]

    def violates(self, g: Tensor) -> Tensor:
        """M of gaps g (batch,), boolean (batch,)."""
        return self.u_c.constraint.clearance(_beside(g))[:, 0] < 0

    def collision_rate(self, g: Tensor) -> float:
        """The share of gaps g (batch,) in collision."""
        return float(self.violates(g).float().mean())


class Shifts(NamedTuple):
    """How far one unit of t at lambda = 1 takes the demonstrations that collide, n of them, by S grad C(x_1).

    Attributes:
        gradient: grad C along the demonstration whose clearance is the median, float64 (T, D).
        along: S grad C along the same one, (T, D), for the paper's filter and the covariant S.
        deviations: S grad C of all of them, `in_deviations`, (n, m, D), for the same.
    """

    gradient: Tensor
    along: Mapping[str, Tensor]
    deviations: Mapping[str, Tensor]

    @classmethod
    def of(cls, settings: Config) -> "Shifts":
        """Of the swaps that the settings describe."""
        x = demonstrations(settings)
        constraint, source = label(settings), build_source(settings.source, x.shape[1])
        # In float64 from end to end: in the trailing modes float32's rounding would be larger than what is to be seen.
        x = x[constraint.violation(x)].double()
        g = constraint.gradient(x)
        u = {FILTER: paper_filter(settings, x.shape[1]) @ g, COVARIANT: covariant(source.covariance) @ g}
        middling = int(constraint.clearance(x).amin(dim=1).median(dim=0).indices)
        return cls(
            g[middling],
            {name: one[middling] for name, one in u.items()},
            {name: in_deviations(source, one) for name, one in u.items()},
        )

    def norms(self) -> dict[str, Tensor]:
        """The Cameron-Martin norm |u| = sqrt(sum_k |e_k^T u|^2 / lambda_k), (n,): how many standard deviations."""
        return {name: z.square().sum(dim=(1, 2)).sqrt() for name, z in self.deviations.items()}


def in_deviations(source: Source, u: Tensor) -> Tensor:
    """e_k^T u / sqrt(lambda_k): shifts u (batch, T, D) in the source's standard deviations by mode, (batch, m, D)."""
    return source.modes.mT @ u / source.variance.sqrt()[:, None]


class ExactFlow(NamedTuple):
    """Samples of the flow of the loss's exact minimiser, for one correction.

    Attributes:
        collisions: how many of SAMPLES end in collision, by the weight lambda_c.
        astray: root mean square of x_t beyond the kept modes at the settings' lambda_c, in the source's standard
            deviations, (SAMPLE_STEPS + 1,).
    """

    collisions: Mapping[float, int]
    astray: Tensor


def exact_flows(settings: Config, weights: Sequence[float]) -> tuple[dict[str, ExactFlow], float]:
    """What minimising L_CG exactly leads to, by correction, and the share of demonstrations in collision.

    Args:
        settings: of the demonstrations, source, constraint and filter.
        weights: lambda_c to sample at, beside that of the settings.
    """
    nominal = _with_one_end(settings)
    x_1, lambda_c = demonstrations(nominal)[:PAIRS], nominal.correction.lambda_c
    source, constraint = build_source(nominal.source, x_1.shape[1]), label(nominal)
    at_closest = label(replace(nominal, constraint=replace(nominal.constraint, reduction="closest")))
    smoothing, M = paper_filter(nominal, x_1.shape[1]), constraint.violation(x_1)
    corrections = {
        FILTER: Correction(constraint, smoothing),
        CLOSEST: Correction(at_closest, smoothing),
        COVARIANT: Correction(constraint, covariant(source.covariance)),
    }
    flows = {}
    for name, u_c in corrections.items():
        collisions, astray = {}, torch.empty(0)
        for weight in sorted({*weights, lambda_c}):
            path = sampled(source, x_1, minimiser(source, x_1, M, u_c, weight))
            collisions[weight] = int(constraint.violation(path[-1]).sum())
            if weight == lambda_c:
                astray = torch.stack([_astray(source, x) for x in path])
        flows[name] = ExactFlow(collisions, astray)
    return flows, float(M.float().mean())


def sampled(source: Source, x_1: Tensor, v: Field) -> list[Tensor]:
    """The states of SAMPLES samples of the source under a field v, SAMPLE_STEPS + 1 of (SAMPLES, T, D), float64.

    Args:
        source: of x_0.
        x_1: demonstrations (N, T, D) that all have the same start and goal, which the samples take too.
        v: the field.
    """
    y = source.observe(x_1[:1]).expand(SAMPLES, -1, -1).double()
    z = torch.randn(SAMPLES, source.modes.shape[1], y.shape[2], dtype=y.dtype, generator=random_stream("explain"))
    return list(states(v, source.mean(y) + source.modes * source.variance.sqrt() @ z, SAMPLE_STEPS))


class Widths(NamedTuple):
    """The source of one kernel beside the feasible demonstrations, mode by mode.

    Attributes:
        length_scale: the kernel's, as a share of the trajectory's time.
        source: with this kernel.
        demonstrations: root mean square of D+ in each mode, (m,), beside the source's sqrt(lambda_k).
        left_out: the largest coordinate of D+ that is in none of the kept modes.
    """

    length_scale: float
    source: Source
    demonstrations: Tensor
    left_out: float

    @classmethod
    def of(cls, settings: Config) -> "tuple[Widths, Widths]":
        """With the settings' kernel, and with the one that is most likely for D+."""
        x = demonstrations(settings)
        x = x[~label(settings).violation(x)].double()
        likely = fitted(replace(settings, source=replace(settings.source, fit=True)), x)
        given, best = (cls._with(one, x) for one in (settings, likely))
        return given, best

    @classmethod
    def _with(cls, settings: Config, x: Tensor) -> "Widths":
        source, K = build_source(settings.source, x.shape[1]), kept()
        z = coordinates(source, x)
        left_out = float((source.modes[:, K:] @ z[:, K:]).abs().max())
        return cls(settings.source.length_scale, source, z.square().mean(dim=(0, 2)).sqrt(), left_out)


class Ends(NamedTuple):
    """Collisions on the straight way from x_0 to x_1, at x_t and at the end E[x_1 | x_t] that is expected from there.

    All are of (TIMES,). Pushes are mean max_s |u^c| at lambda = 1 over feasible pairs, in workspace units per t, with
    the covariant correction. What a sign of a colliding x_1 tells is its share among D- minus that among D+.

    Attributes:
        t: times of the flow.
        at, end: the share of feasible pairs in collision at x_t, and at the expected end.
        push_at, push_end: the push there.
        push_1: the push at x_1 itself, one number: the softplus's tail.
        at_tells, end_tells: what it tells that x_t, or the expected end, collides.
        mask_tells: what E[M | x_t] > E[M] tells: by Bayes's rule no function of x_t tells more.
    """

    t: Tensor
    at: Tensor
    end: Tensor
    push_at: Tensor
    push_end: Tensor
    push_1: float
    at_tells: Tensor
    end_tells: Tensor
    mask_tells: Tensor

    @classmethod
    def of(cls, settings: Config) -> "Ends":
        """Of the swaps that the settings describe, without jitter."""
        # Modes beyond those kept are as wide as their white part, and would tell x_1 long before the others do.
        nominal = _with_one_end(replace(settings, source=replace(settings.source, modes=kept())))
        x = demonstrations(nominal)
        constraint, source = label(nominal), build_source(nominal.source, x.shape[1])
        u_c = Correction(constraint, covariant(source.covariance))
        violates = constraint.violation(x)
        feasible, pairs, M = x[~violates][:PAIRS], x[:PAIRS], violates[:PAIRS]
        t = torch.arange(TIMES) / TIMES
        rows = []
        for now in t.tolist():
            way, every = expected(source, feasible, now), expected(source, pairs, now)
            rows.append(
                (
                    _share(constraint.violation(way.x_t)),
                    _share(constraint.violation(way.end)),
                    _size(u_c(way.x_t)),
                    _size(u_c(way.end)),
                    _tells(constraint.violation(every.x_t), M),
                    _tells(constraint.violation(every.end), M),
                    _tells(every.weights @ M.float() > M.float().mean(), M),
                )
            )
        at, end, push_at, push_end, *tell = torch.tensor(rows).unbind(dim=1)
        return cls(t, at, end, push_at, push_end, _size(u_c(feasible)), *tell)


def clearing_times(settings: Config, T: int, length_scale: float) -> dict[str, float]:
    """lambda t until x' = lambda S grad C(x) has taken most of D- out of collision, in workspace units, by the S used.

    These are the source's covariance Sigma at three scales and the paper's filter. By definition the time of a S is
    that of S divided by a, so that Sigma is followed once.

    Args:
        settings: of everything else.
        T: waypoints.
        length_scale: the source's, as a share of the trajectory's time.
    """
    chosen = replace(settings, data=replace(settings.data, horizon=T, num=PAIRS // 2))
    x = demonstrations(chosen)
    constraint = label(chosen)
    x = x[constraint.violation(x)]
    Sigma = build_source(replace(settings.source, length_scale=length_scale), T).covariance
    row_sum = clearing_time(Correction(constraint, covariant(Sigma)), x)
    sigma = row_sum / float(Sigma.abs().sum(dim=1).max())
    smoothed = clearing_time(Correction(constraint, paper_filter(settings, T)), x)
    return {ROW_SUM: row_sum, PEAKED: sigma * float(Sigma.max()), SIGMA: sigma, FILTER: smoothed}


def clearing_time(u_c: Correction, x: Tensor, h: float = 0.01) -> float:
    """The time in which x' = u^c(x) takes CLEARED of the colliding x (batch, T, D) out of collision, to h."""
    steps = 0
    while (u_c.constraint.clearance(x).amin(dim=1) < 0).float().mean() > 1 - CLEARED:
        x, steps = x + h * u_c(x), steps + 1
    return steps * h


def _with_one_end(settings: Config) -> Config:
    """Without jitter, so that all demonstrations have the same start and goal, y, as exact expectations need."""
    return replace(settings, data=replace(settings.data, jitter=0))


def _middles(count: int) -> Tensor:
    """The middles of `count` equal parts of [0, 1]: levels of quantiles that stand for a law without chance."""
    return (torch.arange(count) + 0.5) / count


def _beside(g: Tensor) -> Tensor:
    """Two robots at one waypoint with y1 - y2 = g (batch,), as trajectories (batch, 1, 4)."""
    zero = torch.zeros_like(g)
    return torch.stack([zero, g / 2, zero, -g / 2], dim=1)[:, None]


def _astray(source: Source, x: Tensor) -> Tensor:
    """The root mean square of x (batch, T, D) in the modes beyond those kept, in standard deviations."""
    return whitened(source, x).unflatten(1, (-1, x.shape[2]))[:, kept() :].square().mean().sqrt()


def _share(holds: Tensor) -> float:
    return float(holds.float().mean())


def _size(u: Tensor) -> float:
    """The largest coordinate of shifts u (batch, T, D) along the trajectory, mean over the batch."""
    return float(u.abs().amax(dim=(1, 2)).mean())


def _tells(sign: Tensor, M: Tensor) -> float:
    """How well a sign, boolean (batch,), tells those of M from the others: its share among them minus the rest's."""
    return float(sign[M].float().mean() - sign[~M].float().mean())
