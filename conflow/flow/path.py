"""The conditional probability path between a source sample and a demonstration (paper: "Preliminaries")."""

import torch
from torch import Tensor


def interpolate(x_0: Tensor, x_1: Tensor, t: Tensor) -> Tensor:
    """x_t = (1 - t) x_0 + t x_1 for x (batch, T, D) and t (batch,).

    `lerp` rather than the formula: x_0 and x_1 are met to the last bit at t = 0 and 1, and a waypoint at which
    both agree stays where it is for every t.
    """
    return torch.lerp(x_0, x_1, t[:, None, None])


def velocity(x_0: Tensor, x_1: Tensor) -> Tensor:
    """u_t = d x_t / dt = x_1 - x_0, the same for every t, (batch, T, D)."""
    return x_1 - x_0
