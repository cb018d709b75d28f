"""What the generators of two robots that swap sides have in common."""

import numpy as np
import torch
from torch import Tensor

# The two robots' nominal starts; each one's goal is the other's start.
SIDES = ((-0.8, 0.0), (0.8, 0.0))

# What `passing` and `social` keep away from the radius, so that rounding to float32 changes no label.
MARGIN = 1e-3


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Uniform in [-1, 1]."""
    return 2 * torch.rand(*shape, generator=generator) - 1


def some(share: float, num: int, generator: torch.Generator) -> Tensor:
    """A share of `num`, to the nearest whole number, drawn by chance: boolean (num,)."""
    return torch.randperm(num, generator=generator) < round(share * num)


def ends(num: int, jitter: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Starts p and goals q of both robots, (num, 2, 2) each."""
    sides = torch.tensor(SIDES)
    p = sides + jitter * uniform(generator, num, 2, 2)
    return p, sides.flip(0) + jitter * uniform(generator, num, 2, 2)


def harmonics(count: int, T: int) -> Tensor:
    """sin(k pi s) for k = 1, ..., count, (count, T), zero at both ends."""
    s = torch.linspace(0, 1, T, dtype=torch.float64)
    harmonics = torch.from_numpy(np.sin((torch.pi * torch.arange(1, count + 1)[:, None] * s).numpy()))
    harmonics[:, -1] = 0  # sin(k pi) in floating point is not
    return harmonics


def trajectories(p: Tensor, q: Tensor, s: Tensor, deviation: Tensor) -> Tensor:
    """p + s (q - p) + deviation n, (num, T, 4), with n the unit normal to the left of travel; s (T,) or (num, 2, T)."""
    travel = q - p
    n = torch.stack([-travel[..., 1], travel[..., 0]], dim=-1) / torch.linalg.vector_norm(travel, dim=-1, keepdim=True)
    line = torch.lerp(p[:, :, None], q[:, :, None], s[..., None])
    return (line + deviation[..., None] * n[:, :, None]).transpose(1, 2).flatten(2)


def distances(x: Tensor) -> Tensor:
    """The distance of two robots at every waypoint of x (num, T, 4), (num, T)."""
    return torch.linalg.vector_norm(x[..., :2] - x[..., 2:], dim=2)
