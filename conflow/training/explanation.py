"""What the pictures of `make explain` show: closed forms beside numbers, from our own parts and without a run."""

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
from conflow.training.build import build_source, build_task, labels, random_stream
from conflow.training.closed_form import posterior, whitened
from conflow.training.config import Config

PAIRS = 2000
"""Demonstrations, each with its own x_0, over which expectations in the space of trajectories are taken."""
GAPS, PARTICLES, GAP_STEPS = 500, 1000, 100
CLEARED = 0.9
SAMPLES, SAMPLE_STEPS = 512, 100
ROW_SUM, PEAKED, SIGMA = r"$\Sigma$ / largest row sum (ours)", r"$\Sigma$ / largest entry", r"$\Sigma$"
FILTERED = "Gaussian filter"
"""The matrices S that are compared."""


def label(settings: Config) -> Constraint:
    """What labels the swaps that the settings describe."""
    return labels(settings, build_task(settings))


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
        g_1 = (x[:, middle, 1] - x[:, middle, 3]).quantile(middles(GAPS))
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
        g_0 = self.sd * torch.special.ndtri(middles(PARTICLES))
        return torch.stack([g[:, 0, 0] for g in states(self.field(weight), g_0[:, None, None], GAP_STEPS)])

    def velocities(self, t: Tensor, g: Tensor, weight: float) -> Tensor:
        """The field at times t (n,) and gaps g (m,), (m, n)."""
        v = self.field(weight)
        return torch.cat([v(g[:, None, None], one.expand(len(g)))[:, :, 0] for one in t], dim=1)

    def push(self, g: Tensor) -> Tensor:
        """What the correction adds to dg/dt at gaps g (batch, 1): both robots move."""
        u_c = self.u_c(beside(g[:, 0]))
        return u_c[..., 1] - u_c[..., 3]

    def violates(self, g: Tensor) -> Tensor:
        """M of gaps g (batch,), boolean (batch,)."""
        return self.u_c.constraint.clearance(beside(g))[:, 0] < 0

    def collision_rate(self, g: Tensor) -> float:
        """The share of gaps g (batch,) in collision."""
        return float(self.violates(g).float().mean())


def in_deviations(source: Source, u: Tensor) -> Tensor:
    """e_k^T u / sqrt(lambda_k): shifts u (batch, T, D) in the source's standard deviations by mode, (batch, m, D)."""
    return source.modes.mT @ u / source.variance.sqrt()[:, None]


def sampled(source: Source, x_1: Tensor, v: Field) -> list[Tensor]:
    """The states of samples of the source, with the ends of demonstrations x_1, under a field."""
    y = source.observe(x_1[:1]).expand(SAMPLES, -1, -1).double()
    z = torch.randn(SAMPLES, source.modes.shape[1], y.shape[2], dtype=y.dtype, generator=random_stream("explain"))
    return list(states(v, source.mean(y) + source.modes * source.variance.sqrt() @ z, SAMPLE_STEPS))


def astray(source: Source, x: Tensor) -> Tensor:
    """The root mean square of x (batch, T, D) in the modes beyond those kept, in standard deviations."""
    return whitened(source, x).unflatten(1, (-1, x.shape[2]))[:, kept() :].square().mean().sqrt()


def clearing_times(settings: Config, T: int, length_scale: float) -> dict[str, float]:
    """lambda t until x' = lambda S grad C(x) has taken most of D- out of collision, for the four matrices S of LOOKS.

    By definition the time of a S is that of S divided by a, so that Sigma is followed once.
    """
    chosen = replace(settings, data=replace(settings.data, horizon=T, num=PAIRS // 2))
    x = demonstrations(chosen)
    constraint = label(chosen)
    x = x[constraint.violation(x)]
    Sigma = build_source(replace(settings.source, length_scale=length_scale), T).covariance
    row_sum = clearing_time(Correction(constraint, covariant(Sigma)), x)
    sigma = row_sum / float(Sigma.abs().sum(dim=1).max())
    smoothed = clearing_time(Correction(constraint, filter_of(settings, T)), x)
    return {ROW_SUM: row_sum, PEAKED: sigma * float(Sigma.max()), SIGMA: sigma, FILTERED: smoothed}


def clearing_time(u_c: Correction, x: Tensor, h: float = 0.01) -> float:
    """The time in which x' = u^c(x) takes CLEARED of the colliding x (batch, T, D) out of collision, to h."""
    steps = 0
    while (u_c.constraint.clearance(x).amin(dim=1) < 0).float().mean() > 1 - CLEARED:
        x, steps = x + h * u_c(x), steps + 1
    return steps * h


def demonstrations(settings: Config) -> Tensor:
    """The swaps that the settings describe, D+ and D-, (N, T, D)."""
    data = settings.data
    return swap(data.num, data.horizon, data.amplitudes, data.jitter, data.seed)


def beside(g: Tensor) -> Tensor:
    """Two robots at one waypoint with y1 - y2 = g (batch,), as trajectories (batch, 1, 4)."""
    zero = torch.zeros_like(g)
    return torch.stack([zero, g / 2, zero, -g / 2], dim=1)[:, None]


def middles(count: int) -> Tensor:
    """The middles of `count` equal parts of [0, 1]: levels of quantiles that stand for a law without chance."""
    return (torch.arange(count) + 0.5) / count


def filter_of(settings: Config, T: int) -> Tensor:
    """The Gaussian filter of these settings, (T, T)."""
    return gaussian_filter(T, settings.correction.sigma, settings.correction.width)


def kept() -> int:
    """The leading modes that the spectral network works in."""
    modes = config.load(["ablation=spectral"]).source.modes
    assert modes is not None
    return modes
