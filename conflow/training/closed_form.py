"""What flow matching over finitely many demonstrations learns when it learns perfectly, in closed form.

Given x_t, each demonstration has a posterior weight, and every expectation is a weighted mean; nothing is trained.
All demonstrations have the same y, that is the same start and goal.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from conflow.flow.path import interpolate
from conflow.flow.sampler import Field
from conflow.flow.source import Source
from conflow.training.build import random_stream


class Way(NamedTuple):
    """Points on straight ways from x_0 to x_1, and what is known there.

    Attributes:
        x_t: the points, (batch, T, D).
        end: E[x_1 | x_t], (batch, T, D).
        weights: `posterior`, (batch, N).
    """

    x_t: Tensor
    end: Tensor
    weights: Tensor


def expected(source: Source, x_1: Tensor, t: float) -> Way:
    """x_t = (1 - t) x_0 + t x_1 of each demonstration x_1 and an x_0 of its own, with E[x_1 | x_t].

    Args:
        source: of x_0.
        x_1: demonstrations, (N, T, D).
        t: the flow's time, in [0, 1).
    """
    x_0 = source.sample(source.observe(x_1), random_stream("explain"))  # the same at every t
    x_t = interpolate(x_0, x_1, torch.full((len(x_1),), t))
    z, z_1 = (whitened(source, x).float() for x in (x_t, x_1))
    weights = posterior(z, z_1, t)
    return Way(x_t, (weights @ x_1.flatten(1)).view_as(x_1), weights)


def minimiser(source: Source, x_1: Tensor, M: Tensor, correction: Callable[[Tensor], Tensor], lambda_c: float) -> Field:
    """The field that minimises L_CG over finitely many demonstrations, exactly.

    v(x, t) = E[x_1 - x_0 | x_t] + lambda_c E[M | x_t] u^c(x_t), the conditional mean of the loss's target. What is
    subtracted off, x_t - E[x_1 | x_t] over 1 - t, brings back everything that no demonstration has. In float64: in the
    source's trailing modes float32's rounding would be larger than what is to be seen.

    Args:
        source: of x_0.
        x_1: demonstrations, (N, T, D).
        M: which of them violate the constraint, boolean (N,).
        correction: u^c, of x (batch, T, D) in float32.
        lambda_c: its weight.

    Returns:
        v of x (batch, T, D), float64, and times t (batch,) that are all the same and below 1.
    """
    z_1, known = whitened(source, x_1), torch.cat([x_1.flatten(1), M[:, None]], dim=1).double()

    def v(x: Tensor, t: Tensor) -> Tensor:
        now = float(t[0])
        end, violates = (posterior(whitened(source, x), z_1, now) @ known).split([x[0].numel(), 1], dim=1)
        pushed = correction(x.float()).to(x.dtype)
        return (end.view_as(x) - x) / (1 - now) + lambda_c * violates[:, :, None] * pushed

    return v


def posterior(z: Tensor, z_1: Tensor, t: float) -> Tensor:
    """P(x_1 = demonstration i | x_t) = softmax_i(-|z - t z_i|^2 / (2 (1 - t)^2)), (batch, N), for t < 1.

    From x_t = (1 - t) x_0 + t x_1 with z_0 ~ N(0, I), all in the source's standard deviations.

    Args:
        z: x_t, (batch, m).
        z_1: demonstrations, (N, m), each as likely as the others.
        t: the flow's time.
    """
    return torch.softmax(torch.cdist(z, t * z_1).square_().mul_(-1 / (2 * (1 - t) ** 2)), dim=1)


def coordinates(source: Source, x: Tensor) -> Tensor:
    """z = E^T (x - W x_O) of trajectories x (batch, T, D), (batch, m, D), float64, in workspace units.

    E has the source's m modes in its columns, and W x_O is its mean for the observed start and goal.
    """
    return source.modes.mT @ (x.double() - source.mean(source.observe(x.double())))


def whitened(source: Source, x: Tensor) -> Tensor:
    """z_k / sqrt(lambda_k): the `coordinates` in the source's standard deviations, (batch, m D), float64."""
    return (coordinates(source, x) / source.variance.sqrt()[:, None]).flatten(1)
