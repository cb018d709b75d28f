"""Constraints on trajectories: clearance, barrier C_gamma and violation M (paper: "Constraint-Guided Objective").

This file is the only notion of "collision": the label M(x_1) of the data, the mask in training, the barrier
that corrects and guides, and the metrics all come from the same `clearance`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from conflow.scene.robots import PointRobots

BarrierShape = Literal["softplus", "relu"]
Reduction = Literal["sum", "mean", "closest"]
SHARED = 1e-12
"""Two bodies that are nearer share a point."""


@dataclass(frozen=True)
class Barrier:
    """The barrier as a function of the clearance c = d - r, and where along the trajectory it is taken.

    softplus: C_gamma = -1/gamma log(1 + exp(-gamma c)) (Eq. c). relu: C = min(c, 0), its limit for large gamma.
    Reduction "sum" and "mean" are over the waypoints; "closest" takes C at the closest approach alone. The paper
    leaves open which of them it means.
    """

    shape: BarrierShape = "softplus"
    reduction: Reduction = "sum"
    gamma: float = 10.0

    def value(self, c: Tensor) -> Tensor:
        """C at clearance c."""
        return -F.softplus(-self.gamma * c) / self.gamma if self.shape == "softplus" else c.clamp(max=0)

    def slope(self, c: Tensor) -> Tensor:
        """dC/dc at clearance c."""
        return torch.sigmoid(-self.gamma * c) if self.shape == "softplus" else (c < 0).to(c.dtype)


@dataclass(frozen=True)
class Obstacle:
    """A disc that the robots must not touch: centre (x, y) and radius, in workspace units."""

    x: float = 0.0
    y: float = 0.5
    radius: float = 0.1


class Constraint(nn.Module, ABC):
    """Clearance, barrier, gradient and violation of trajectories x (batch, T, D)."""

    @abstractmethod
    def clearance(self, x: Tensor) -> Tensor:
        """c = d - r at every waypoint, (batch, T): the gap between the nearest bodies, negative in collision."""

    @abstractmethod
    def swept_clearance(self, x: Tensor) -> Tensor:
        """The smallest c while all bodies move straight from each waypoint to the next, (batch, T - 1).

        Never above the clearance of the two waypoints, and below it where bodies pass each other in between.
        """

    @abstractmethod
    def barrier(self, x: Tensor) -> Tensor:
        """C(x), (batch,): about 0 where feasible, negative where not."""

    @abstractmethod
    def gradient(self, x: Tensor) -> Tensor:
        """grad C(x) in closed form, (batch, T, D): points away from the collision."""

    def violation(self, x: Tensor) -> Tensor:
        """M(x), boolean (batch,): some waypoint is in collision, or is not a number."""
        return ~(self.clearance(x).amin(dim=1) >= 0)


class Sum(Constraint):
    """Several constraints at once: barriers add up, the clearance is the smallest."""

    def __init__(self, terms: Sequence[Constraint]) -> None:
        super().__init__()
        self.terms = cast(Sequence[Constraint], nn.ModuleList(terms))

    def clearance(self, x: Tensor) -> Tensor:
        return torch.stack([term.clearance(x) for term in self.terms]).amin(dim=0)

    def swept_clearance(self, x: Tensor) -> Tensor:
        return torch.stack([term.swept_clearance(x) for term in self.terms]).amin(dim=0)

    def barrier(self, x: Tensor) -> Tensor:
        return torch.stack([term.barrier(x) for term in self.terms]).sum(dim=0)

    def gradient(self, x: Tensor) -> Tensor:
        return torch.stack([term.gradient(x) for term in self.terms]).sum(dim=0)


class Avoidance(Constraint):
    """Pairs of bodies that keep their distance: body points p, separations w = A p - b, clearances |w| - r.

    Args:
        robots: places the body points, `bodies` of them over all robots.
        incidence: A, (pairs, bodies).
        offset: b, (pairs, 2).
        radius: r, (pairs,): the distance at which a pair touches.
        barrier: C as a function of the clearance.
    """

    incidence: Tensor
    offset: Tensor
    radius: Tensor

    def __init__(
        self, robots: PointRobots, incidence: Tensor, offset: Tensor, radius: Tensor, barrier: Barrier
    ) -> None:
        super().__init__()
        self.robots = robots
        self.shape = barrier
        self.register_buffer("incidence", incidence, persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("radius", radius, persistent=False)

    def clearance(self, x: Tensor) -> Tensor:
        return self._pairs(x)[2].amin(dim=2)

    def swept_clearance(self, x: Tensor) -> Tensor:
        # The separation goes straight too, w(tau) = w + tau u, and is shortest at tau = -<w, u> / |u|^2.
        w, _, c = self._pairs(x)
        u = w.diff(dim=1)
        w = w[:, :-1]
        length = (u * u).sum(dim=3).clamp_min(torch.finfo(u.dtype).tiny)  # of bodies that keep their separation: 0
        tau = (-(w * u).sum(dim=3) / length).clamp(0, 1)
        nearest = torch.linalg.vector_norm(w + tau[..., None] * u, dim=3) - self.radius
        # Rounding must not put the closest approach farther away than the ends.
        return torch.minimum(nearest, torch.minimum(c[:, :-1], c[:, 1:])).amin(dim=2)

    def barrier(self, x: Tensor) -> Tensor:
        return self._weight(x) * self.shape.value(self._candidates(self._pairs(x)[2]).min(dim=2).values).sum(dim=1)

    def gradient(self, x: Tensor) -> Tensor:
        w, d, c = self._pairs(x)
        candidates = self._candidates(c)
        nearest = candidates.min(dim=2, keepdim=True)
        slope = self._weight(x) * self.shape.slope(nearest.values)
        dC_dc = torch.zeros_like(candidates).scatter(2, nearest.indices, slope).view_as(c)
        # d|w|/dw = w / |w|; where two bodies share a point there is none, and this is the subgradient 0.
        dC_dw = (dC_dc / d.clamp_min(SHARED))[..., None] * w
        return self.robots.pullback(self.incidence.to(w.dtype).mT @ dC_dw)

    def _pairs(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Separations w (batch, T, pairs, 2), distances d = |w| and clearances c = d - r, both (batch, T, pairs)."""
        p = self.robots.points(x).flatten(2, 3)
        w = torch.einsum("pn,btnk->btpk", self.incidence.to(x.dtype), p) - self.offset
        d = torch.linalg.vector_norm(w, dim=3)
        return w, d, d - self.radius

    def _weight(self, x: Tensor) -> float:
        """What C at one waypoint counts for in C of the trajectory."""
        return 1 / x.shape[1] if self.shape.reduction == "mean" else 1

    def _candidates(self, c: Tensor) -> Tensor:
        """Clearances arranged so that each row's smallest one counts: (batch, T, pairs) or (batch, 1, T pairs)."""
        return c.flatten(1)[:, None] if self.shape.reduction == "closest" else c


class RobotAvoidance(Avoidance):
    """Every two robots keep the distance `radius` between their centres."""

    def __init__(self, robots: PointRobots, radius: float = 0.3, barrier: Barrier | None = None) -> None:
        bodies = torch.eye(robots.count)
        pairs = list(combinations(range(robots.count), 2))
        incidence = torch.stack([bodies[i] - bodies[j] for i, j in pairs])
        super().__init__(
            robots, incidence, torch.zeros(len(pairs), 2), torch.full((len(pairs),), radius), barrier or Barrier()
        )


class ObstacleAvoidance(Avoidance):
    """Every robot, a disc of `robot_radius`, stays clear of every obstacle."""

    def __init__(
        self, robots: PointRobots, obstacles: Sequence[Obstacle], robot_radius: float, barrier: Barrier | None = None
    ) -> None:
        incidence = torch.eye(robots.count).repeat_interleave(len(obstacles), dim=0)
        offset = torch.tensor([[o.x, o.y] for o in obstacles]).repeat(robots.count, 1)
        radius = torch.tensor([robot_radius + o.radius for o in obstacles]).repeat(robots.count)
        super().__init__(robots, incidence, offset, radius, barrier or Barrier())


class Workspace(Constraint):
    """Every robot's position stays in [-1, 1]^2, and `margin` away from its walls: c = 1 - margin - |p|.

    Each wall counts for itself, at every waypoint: a robot in a corner is pushed away from both.
    """

    def __init__(self, robots: PointRobots, margin: float = 0.0, barrier: Barrier | None = None) -> None:
        super().__init__()
        self.robots, self.margin, self.shape = robots, margin, barrier or Barrier()

    def clearance(self, x: Tensor) -> Tensor:
        return self._walls(x)[1].amin(dim=2)

    def swept_clearance(self, x: Tensor) -> Tensor:
        # A square is convex, so between two points inside nothing is nearer to a wall than one of them.
        c = self.clearance(x)
        return torch.minimum(c[:, :-1], c[:, 1:])

    def barrier(self, x: Tensor) -> Tensor:
        return self.shape.value(self._walls(x)[1]).sum(dim=(1, 2))

    def gradient(self, x: Tensor) -> Tensor:
        p, c = self._walls(x)
        return self.robots.pullback((-p.sign() * self.shape.slope(c)).unflatten(2, (-1, 2)))

    def _walls(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Coordinates p of all body points and their clearances, both (batch, T, 2 bodies)."""
        p = self.robots.points(x).flatten(2)
        return p, 1 - self.margin - p.abs()
