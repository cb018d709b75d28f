"""The constraint-induced correction u^c of the velocity (paper: "Constraint-Guided Objective", appendix)."""

from collections.abc import Iterator
from itertools import islice
from typing import Protocol

import torch
from torch import Tensor, nn

from conflow.flow.along import along
from conflow.flow.settings import Edges
from conflow.flow.threads import one_thread


class Differentiable(Protocol):
    """What this room needs of a constraint."""

    def clearance(self, x: Tensor) -> Tensor:
        """c at every waypoint, (batch, T), of x (batch, T, D)."""
        ...

    def barrier(self, x: Tensor) -> Tensor:
        """C, (batch,): 0 where feasible."""
        ...

    def gradient(self, x: Tensor) -> Tensor:
        """grad C at x, both (batch, T, D)."""
        ...

    def clearance_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """c and grad C."""
        ...

    def barrier_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """C and grad C."""
        ...


class Correction(nn.Module):
    """u^c(x) = S grad C(x): the barrier's gradient, smoothed along the trajectory by the matrix S.

    Args:
        constraint: gives grad C.
        smoothing: S, (T, T).
    """

    smoothing: Tensor

    def __init__(self, constraint: Differentiable, smoothing: Tensor) -> None:
        super().__init__()
        self.constraint = constraint
        # Both follow from the config, so a checkpoint need not hold them.
        self.register_buffer("smoothing", smoothing.to(torch.get_default_dtype()), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """u^c at x, both (batch, T, D)."""
        return along(self.smoothing, self.constraint.gradient(x))


@one_thread()
def gaussian_filter(T: int, sigma: float = 5.0, width: int = 9, edges: Edges = "zero") -> Tensor:
    """The Gaussian filter along the trajectory as a matrix, float64 (T, T).

    S_ij = w_{i-j} / sum w with w_k = exp(-k^2 / (2 sigma^2)) for |k| <= (width - 1) / 2. Beyond the ends the
    gradient counts as zero, or as at the nearest end; "normalised" leaves out what is beyond and lets every row sum
    to 1. The paper does not say which.

    >>> gaussian_filter(32, edges="normalised").sum(dim=1).allclose(torch.ones(32, dtype=torch.float64))
    True
    """
    reach = (width - 1) // 2
    k = torch.arange(-reach, reach + 1)
    w = torch.exp(-(k.double() ** 2) / (2 * sigma**2))
    j = torch.arange(T)[:, None] + k  # the waypoint under each tap, (T, width)
    w = (w / w.sum()).repeat(T, 1)
    if edges != "nearest":
        w[(j < 0) | (j >= T)] = 0
    if edges == "normalised":
        w /= w.sum(dim=1, keepdim=True)
    return torch.zeros(T, T, dtype=w.dtype).scatter_add(1, j.clamp(0, T - 1), w)


@one_thread()
def covariant(Sigma: Tensor) -> Tensor:
    """The source's covariance as the smoothing matrix, float64 (T, T): S = Sigma / max_i sum_j |Sigma_ij|.

    Sigma grad C is a shift along which the source's law stays absolutely continuous (Cameron-Martin), so a corrected
    x_t is still one that the source could have led to. It vanishes where the source is conditioned. The scale is the
    Gaussian filter's: the same push at every waypoint moves none of them by more than that push. It makes lambda
    mean the same for every number of waypoints and every length scale.
    """
    return Sigma.double() / Sigma.double().abs().sum(dim=1).max()


def descent(x: Tensor, u_c: Correction, momentum: float = 0.0) -> Iterator[Tensor]:
    """The states x_0 = x, x_1, ... of trajectories (batch, T, D) under descent along the correction S grad C, for ever.

    Newton's steps on C(x) = 0 in the metric of S, with what is left of the step before it:
    V <- momentum V - C / <grad C, S grad C> S grad C, x <- x + V. Each Newton step is the least displacement, as
    measured by S^-1, that solves the linearised equation, so there is no length to choose. For a barrier that is 0
    where feasible. What does not move, such as two bodies that share their whole path, stays as it is, and so does what
    is feasible.
    """
    V = torch.zeros_like(x)
    while True:
        yield x
        C, g = u_c.constraint.barrier_and_gradient(x)
        moving = along(u_c.smoothing, g) * (C < 0)[:, None, None]
        slope = (g * moving).sum(dim=(1, 2))
        step = torch.where(slope > 0, -C / slope.clamp_min(torch.finfo(x.dtype).tiny), 0)[:, None, None] * moving
        V = momentum * V * (C < 0)[:, None, None] + step
        x = x + V


def descend(x: Tensor, u_c: Correction, steps: int, momentum: float = 0.0) -> Tensor:
    """Where `descent` has come after so many steps, (batch, T, D); with a relu barrier it repairs demonstrations."""
    return next(islice(descent(x, u_c, momentum), steps, None))
