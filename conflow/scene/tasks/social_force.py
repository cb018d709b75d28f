"""Two robots that evade each other by the social-force model (Helbing and Molnar, Phys. Rev. E 51, 4282, 1995)."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# Units: half the workspace's width, and seconds.
STEP = 0.02
LONGEST = 8.0

# Relaxation time towards the desired velocity. A robot begins to brake where it would need three times that to arrive:
# four would be critical damping, and from within REACHED of the goal it takes the last step.
TAU = 0.2
BRAKING = 3 * TAU
REACHED = 0.01

# The share of a repulsion that a robot feels from behind.
BEHIND = 0.2


class Robots(NamedTuple):
    """Pairs of robots and their habits; of each robot a vector, (num, 2, 2), or a number, (num, 2).

    Attributes:
        start, goal: positions.
        speed: the desired one, v.
        drift: the angle from the goal's direction to the desired one, positive to the left.
        repulsion, reach: A and B of A exp((radius - d) / B), away from a robot at distance d.
        sidestep, sight: the same for the force to the side, to the left of the goal's direction where A > 0.
    """

    start: Tensor
    goal: Tensor
    speed: Tensor
    drift: Tensor
    repulsion: Tensor
    reach: Tensor
    sidestep: Tensor
    sight: Tensor


def walk(robots: Robots, T: int, radius: float) -> tuple[Tensor, Tensor]:
    """Trajectories x (num, T, 4) from rest until both have arrived, and when each had, as a share of it, (num, 2).

    dv/dt = (v_desired - v) / TAU + f (BEHIND + (1 - BEHIND) (1 + c) / 2) n + g max(c, 0) n_left, in semi-implicit Euler
    steps: f and g are the repulsion and the sidestep, n points away from the other robot, n_left to the left of the
    goal, and c is the cosine of the angle between the goal and the other robot. Who has arrived stays. All is NaN
    of a pair of which a robot has not arrived by LONGEST.
    """
    position, velocity = robots.start, torch.zeros_like(robots.start)
    arrival = torch.full_like(robots.speed, torch.nan)
    path = [position]
    for step in range(1, round(LONGEST / STEP) + 1):
        velocity = velocity + STEP * _acceleration(robots, position, velocity, radius)
        position = position + STEP * velocity
        near = torch.linalg.vector_norm(robots.goal - position, dim=2) < REACHED
        arrival = torch.where(near & arrival.isnan(), step, arrival)
        position = torch.where(arrival.isnan()[..., None], position, robots.goal)
        path.append(position)
    end = arrival.amax(dim=1, keepdim=True)
    return _resampled(torch.stack(path, dim=1).flatten(2), end, T), arrival / end


def _acceleration(robots: Robots, position: Tensor, velocity: Tensor, radius: float) -> Tensor:
    ahead, to_go = _direction(robots.goal - position)
    left = torch.stack([-ahead[..., 1], ahead[..., 0]], dim=2)
    # NumPy's cos, sin and exp, here and below: of two threads that share torch's one may be less accurate.
    cos, sin = (torch.from_numpy(function(robots.drift.numpy()))[..., None] for function in (np.cos, np.sin))
    heading = cos * ahead + sin * left
    desired = torch.minimum(robots.speed[..., None], to_go / BRAKING) * heading

    away, distance = _direction(position - position.flip(1))
    c = -(away * ahead).sum(dim=2, keepdim=True)
    repulsion = _force(robots.repulsion, robots.reach, radius - distance) * (BEHIND + (1 - BEHIND) * (1 + c) / 2)
    sidestep = _force(robots.sidestep, robots.sight, radius - distance) * c.clamp(min=0)
    return (desired - velocity) / TAU + repulsion * away + sidestep * left


def _direction(v: Tensor) -> tuple[Tensor, Tensor]:
    """The unit vectors and the lengths of v (num, 2, 2), (num, 2, 1), without a division by zero."""
    length = torch.linalg.vector_norm(v, dim=2, keepdim=True).clamp(min=1e-9)
    return v / length, length


def _force(strength: Tensor, reach: Tensor, depth: Tensor) -> Tensor:
    """A exp(depth / B), (num, 2, 1), no more than A e: robots that overlap do not fly apart."""
    return strength[..., None] * torch.from_numpy(np.exp((depth / reach[..., None]).clamp(max=1).numpy()))


def _resampled(path: Tensor, end: Tensor, T: int) -> Tensor:
    """T waypoints of `path` (num, steps, 4), evenly from its first step to `end` (num, 1), linear between steps."""
    at = end.nan_to_num() * torch.linspace(0, 1, T, dtype=path.dtype)
    step = at.long().clamp(max=path.shape[1] - 2)[..., None]
    x = torch.lerp(path.take_along_dim(step, dim=1), path.take_along_dim(step + 1, dim=1), at[..., None] - step)
    return x.where(~end.isnan()[..., None], torch.nan)
