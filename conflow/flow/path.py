"""The conditional probability path between a source sample and a demonstration (paper: "Preliminaries")."""

from collections.abc import Callable

import torch
from torch import Tensor


def interpolate(x_0: Tensor, x_1: Tensor, t: Tensor) -> Tensor:
    """x_t = (1 - t) x_0 + t x_1 for x (batch, T, D) and t (batch,).

    `lerp` rather than the formula: x_0 and x_1 are met to the last bit at t = 0 and 1, and a waypoint at which
    both agree stays where it is for every t.

    >>> interpolate(torch.zeros(2, 1, 1), torch.ones(2, 1, 1), torch.tensor([0.25, 1.0])).flatten()
    tensor([0.2500, 1.0000])
    """
    return torch.lerp(x_0, x_1, t[:, None, None])


def velocity(x_0: Tensor, x_1: Tensor) -> Tensor:
    """u_t = d x_t / dt = x_1 - x_0, the same for every t, (batch, T, D)."""
    return x_1 - x_0


def end(x_t: Tensor, u_t: Tensor, t: Tensor) -> Tensor:
    """x_t + (1 - t) u_t: where the straight path through x_t with velocity u_t (batch, T, D) ends at t = 1.

    With the marginal velocity E[x_1 - x_0 | x_t] it is E[x_1 | x_t], the demonstration expected from x_t on.

    >>> x_0, x_1, t = torch.zeros(1, 1, 1), torch.ones(1, 1, 1), torch.tensor([0.25])
    >>> end(interpolate(x_0, x_1, t), velocity(x_0, x_1), t).item()
    1.0
    """
    return x_t + (1 - t[:, None, None]) * u_t


def guided_path(
    x_0: Tensor, x_1: Tensor, t: Tensor, correction: Callable[[Tensor], Tensor], weight: Tensor, steps: int = 4
) -> tuple[Tensor, Tensor]:
    """x_t and u_t of the guided conditional path x' = (x_1 - x_0) + weight u^c(x), x(0) = x_0.

    u_t is the velocity of the path at its own point, so a field that matches it transports the source to where these
    paths end, not to x_1. Without weight it is the straight path.

    Args:
        x_0: sample of the source, (batch, T, D).
        x_1: demonstration, (batch, T, D).
        t: (batch,), the time to which each path is followed.
        correction: u^c.
        weight: (batch,).
        steps: of the midpoint rule from 0 to t, two evaluations of u^c each.
    """
    straight, h = velocity(x_0, x_1), t[:, None, None] / steps

    def u(x: Tensor) -> Tensor:
        return straight + weight[:, None, None] * correction(x)

    x = x_0
    for _ in range(steps):
        x = x + h * u(x + h / 2 * u(x))
    return x, u(x)
