"""The social-force model of two pedestrians or robots that meet (Helbing and Molnar 1995, Phys. Rev. E 51, 4282)."""

from typing import NamedTuple

import torch
from torch import Tensor

# Relaxation time, time step and the longest time that is simulated; a speed is in half widths of the workspace a unit.
TAU, STEP, LONGEST = 0.15, 0.02, 8.0

# Deceleration with which a robot comes to rest, and how near its goal it takes the last step.
BRAKE, REACHED = 1.5, 0.01

# What is left of a repulsion from a robot that is not ahead.
BEHIND = 0.2


class Robots(NamedTuple):
    """Pairs of robots and their habits: a pair of vectors (num, 2, 2) or of numbers (num, 2) each.

    Attributes:
        start, goal: positions.
        speed: the desired one.
        drift: angle from the goal's direction to the desired one, positive to the left.
        strength, reach: the repulsion A exp((radius - d) / B) from a robot at distance d.
        side: where a robot evades another one ahead, 1 to its left and -1 to its right.
    """

    start: Tensor
    goal: Tensor
    speed: Tensor
    drift: Tensor
    strength: Tensor
    reach: Tensor
    side: Tensor


def walk(robots: Robots, T: int, radius: float) -> tuple[Tensor, Tensor]:
    """Trajectories x (num, T, 4) over the time that the later robot takes, and each robot's share of it, (num, 2).

    dv/dt = (v_desired - v) / TAU + A exp((radius - d) / B) ((BEHIND + (1 - BEHIND) c) n + side c n_left), from rest
    at the start, with n the unit vector away from the other robot and c the cosine at which that is ahead, 0 if it is
    not. v_desired points to the goal, turned by `drift`, at the desired speed or that of braking. Who arrives stays.
    NaN where a robot does not arrive within LONGEST.
    """
    position, velocity = robots.start, torch.zeros_like(robots.start)
    arrival = torch.full_like(robots.speed, torch.nan)
    path = [position]
    for step in range(1, round(LONGEST / STEP) + 1):
        velocity = velocity + STEP * _acceleration(robots, position, velocity, radius)
        position = position + STEP * velocity
        reached = torch.linalg.vector_norm(robots.goal - position, dim=2) < REACHED
        arrival = arrival.where(~(arrival.isnan() & reached), step)
        at_rest = ~arrival.isnan()[..., None]
        position = torch.where(at_rest, robots.goal, position)
        velocity = velocity.where(~at_rest, 0.0)
        path.append(position)
    latest = arrival.amax(dim=1, keepdim=True)
    return _resampled(torch.stack(path, dim=1).flatten(2), latest, T), arrival / latest


def _acceleration(robots: Robots, position: Tensor, velocity: Tensor, radius: float) -> Tensor:
    to_goal = robots.goal - position
    left_to_go = torch.linalg.vector_norm(to_goal, dim=2).clamp(min=1e-9)[..., None]
    ahead = to_goal / left_to_go
    left = torch.stack([-ahead[..., 1], ahead[..., 0]], dim=2)
    turn = robots.drift[..., None]
    speed = torch.minimum(robots.speed[..., None], (2 * BRAKE * left_to_go).sqrt())
    desired = speed * (turn.cos() * ahead + turn.sin() * left)

    away = position - position.flip(1)
    distance = torch.linalg.vector_norm(away, dim=2, keepdim=True).clamp(min=1e-9)
    away = away / distance
    repulsion = robots.strength[..., None] * ((radius - distance) / robots.reach[..., None]).clamp(max=1).exp()
    c = -(away * ahead).sum(dim=2, keepdim=True).clamp(max=0)
    evasion = (BEHIND + (1 - BEHIND) * c) * away + robots.side[..., None] * c * left
    return (desired - velocity) / TAU + repulsion * evasion


def _resampled(path: Tensor, latest: Tensor, T: int) -> Tensor:
    """T waypoints of `path` (num, steps, 4), linear between steps, evenly from the first one to `latest` (num, 1)."""
    at = latest.nan_to_num(1.0) * torch.linspace(0, 1, T, dtype=torch.float64)
    before = at.long().clamp(max=path.shape[1] - 2)
    x = torch.lerp(
        path.take_along_dim(before[..., None], dim=1),
        path.take_along_dim(before[..., None] + 1, dim=1),
        (at - before)[..., None],
    )
    return x.where(~latest.isnan()[..., None], torch.nan)
