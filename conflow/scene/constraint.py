"""Constraints on trajectories: clearance, barrier C_gamma and violation M (paper: "Constraint-Guided Objective").

This file is the only notion of "collision": the label M(x_1) of the data, the mask in training, the barrier
that corrects and guides, and the metrics all come from the same `clearance`.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from conflow.scene.robots import Robots
from conflow.scene.settings import Ball, BarrierShape, Obstacle, Pairs, Reduction

SHARED = 1e-12
"""Two bodies that are nearer share a point."""
PARTS = 8
"""Into which a trajectory is divided between two waypoints, where a constraint knows no better."""

Pullback = Callable[[Tensor], Tensor]
"""Of weights g (batch, T, n) on clearances to the gradient of sum g c with respect to x, (batch, T, D)."""


@dataclass(frozen=True)
class Barrier:
    """The barrier as a function of the clearances c = d - r, and which of them count.

    softplus: C_gamma = -1/gamma log(1 + exp(-gamma c)) (Eq. c). relu: C = min(c, 0), its limit for large gamma.
    square: C = -min(c, 0)^2 / 2, whose slope goes to 0 with the violation.
    Reduction "sum" and "mean" are over the waypoints; "closest" takes C at the closest approach alone. The paper
    leaves open which of them it means. Of the clearances at a waypoint the smallest counts, or all do.

    >>> Barrier("relu").total(torch.tensor([[[0.1, -0.2], [-0.3, -0.1]]]))
    tensor([-0.5000])
    """

    shape: BarrierShape = "softplus"
    reduction: Reduction = "sum"
    gamma: float = 10.0
    pairs: Pairs = "nearest"

    def value(self, c: Tensor) -> Tensor:
        """C at clearance c."""
        if self.shape == "softplus":
            return -F.softplus(-self.gamma * c) / self.gamma
        return c.clamp(max=0) if self.shape == "relu" else -c.clamp(max=0).square() / 2

    def slope(self, c: Tensor) -> Tensor:
        """dC/dc at clearance c."""
        if self.shape == "softplus":
            return torch.sigmoid(-self.gamma * c)
        return (c < 0).to(c.dtype) if self.shape == "relu" else -c.clamp(max=0)

    def total(self, c: Tensor) -> Tensor:
        """C of trajectories with clearances c (batch, T, n), (batch,)."""
        if self.pairs == "all":
            return self._weighted(self.value(c).sum(dim=(1, 2)), c)
        return self._weighted(self.value(self._candidates(c).min(dim=2).values).sum(dim=1), c)

    def slopes(self, c: Tensor) -> Tensor:
        """dC/dc of the same, (batch, T, n)."""
        candidates = self._candidates(c)
        if self.pairs == "all" or candidates.shape[2] == 1:
            return self._weighted(self.slope(c), c)
        nearest = candidates.min(dim=2, keepdim=True)
        slope = self._weighted(self.slope(nearest.values), c)
        return torch.zeros_like(candidates).scatter(2, nearest.indices, slope).view_as(c)

    def _weighted(self, value: Tensor, c: Tensor) -> Tensor:
        """A value of waypoints as it counts in C of the trajectory."""
        return value / c.shape[1] if self.reduction == "mean" else value

    def _candidates(self, c: Tensor) -> Tensor:
        """Clearances arranged so that each row's smallest one counts: (batch, T, n) or (batch, 1, T n)."""
        return c.flatten(1)[:, None] if self.reduction == "closest" else c


class Constraint(nn.Module, ABC):
    """What trajectories x (batch, T, D) of some robots must keep: `clearance` says by how much they do.

    The rest follows from it. Where a constraint knows a closed form it overrides: several `clearances` a waypoint in
    place of the smallest, their `vjp` in place of automatic differentiation, `swept_clearance` in place of subdivision,
    `closest` where it knows between which waypoints it need not look.

    Attributes:
        robots: what moves.
        shape: C as a function of the clearances.
    """

    def __init__(self, robots: Robots) -> None:
        super().__init__()
        self.robots, self.shape = robots, Barrier()

    @abstractmethod
    def clearance(self, x: Tensor) -> Tensor:
        """c = d - r at every waypoint, (batch, T): the gap between the nearest bodies, negative in violation."""

    def clearances(self, x: Tensor) -> Tensor:
        """All that are known at every waypoint, (batch, T, n), such as one for every pair of bodies."""
        return self.clearance(x)[..., None]

    def vjp(self, x: Tensor) -> tuple[Tensor, Pullback]:
        """The clearances c(x), (batch, T, n), and what turns weights g on them into the gradient of sum g c."""
        with torch.enable_grad():
            x = x.detach().requires_grad_()
            c = self.clearances(x)
        return c.detach(), lambda g: torch.autograd.grad(c, x, g.to(c.dtype))[0]

    def swept_clearance(self, x: Tensor) -> Tensor:
        """The smallest c while x goes straight from each waypoint to the next, (batch, T - 1).

        Never above the clearance of the two waypoints, and below it where bodies pass each other in between. Here it is
        the smallest of PARTS + 1 evenly spaced points.
        """
        tau = torch.arange(PARTS, dtype=x.dtype, device=x.device)[:, None] / PARTS
        between = torch.lerp(x[:, :-1, None], x[:, 1:, None], tau).flatten(1, 2)
        c = self.clearance(x)
        on_the_way = self.clearance(torch.cat([between, x[:, -1:]], dim=1)).unfold(1, PARTS + 1, PARTS).amin(dim=2)
        # A clearance of steps between waypoints, such as a speed's, is larger of smaller steps.
        return torch.minimum(on_the_way, torch.minimum(c[:, :-1], c[:, 1:]))

    def closest(self, x: Tensor, known: Tensor | None = None) -> Tensor:
        """The smallest c on the way of each trajectory, that of `swept_clearance`, (batch,).

        Where something else is known to be as small as `known` (batch,), the smaller of the two: so what cannot be
        below that need not be looked at.
        """
        c = self.swept_clearance(x).amin(dim=1)
        return c if known is None else torch.minimum(c, known)

    def barrier(self, x: Tensor) -> Tensor:
        """C(x), (batch,): about 0 where feasible, negative where not."""
        return self.shape.total(self.clearances(x))

    def gradient(self, x: Tensor) -> Tensor:
        """grad C(x), (batch, T, D): points away from the violation."""
        c, pullback = self.vjp(x)
        return pullback(self.shape.slopes(c))

    def clearance_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """c, (batch, T), and grad C(x), (batch, T, D), from the same clearances."""
        c, pullback = self.vjp(x)
        return c.amin(dim=2), pullback(self.shape.slopes(c))

    def barrier_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """C(x), (batch,), and grad C(x), (batch, T, D), from the same clearances."""
        c, pullback = self.vjp(x)
        return self.shape.total(c), pullback(self.shape.slopes(c))

    def violation(self, x: Tensor) -> Tensor:
        """M(x), boolean (batch,): some waypoint is in violation, or is not a number."""
        return ~(self.clearance(x).amin(dim=1) >= 0)

    def shaped(self, shape: Barrier, margin: float = 0.0) -> "Constraint":
        """The same constraint with another barrier, and with all clearances smaller by a margin."""
        made = copy.deepcopy(self)
        made.shape = shape
        return made.narrowed(margin) if margin else made

    def narrowed(self, margin: float) -> "Constraint":
        """The same with all clearances smaller by a margin."""
        return Narrowed(self, margin)


class Narrowed(Constraint):
    """A constraint of which a margin more is kept."""

    def __init__(self, constraint: Constraint, margin: float) -> None:
        super().__init__(constraint.robots)
        self.constraint, self.margin, self.shape = constraint, margin, constraint.shape

    def clearance(self, x: Tensor) -> Tensor:
        return self.constraint.clearance(x) - self.margin

    def clearances(self, x: Tensor) -> Tensor:
        return self.constraint.clearances(x) - self.margin

    def vjp(self, x: Tensor) -> tuple[Tensor, Pullback]:
        c, pullback = self.constraint.vjp(x)
        return c - self.margin, pullback

    def swept_clearance(self, x: Tensor) -> Tensor:
        return self.constraint.swept_clearance(x) - self.margin

    def closest(self, x: Tensor, known: Tensor | None = None) -> Tensor:
        return self.constraint.closest(x, None if known is None else known + self.margin) - self.margin


class Sum(Constraint):
    """Several constraints at once: barriers add up, the clearance is the smallest."""

    def __init__(self, terms: Sequence[Constraint]) -> None:
        super().__init__(terms[0].robots)
        self.terms = cast(Sequence[Constraint], nn.ModuleList(terms))

    def clearance(self, x: Tensor) -> Tensor:
        return torch.stack([term.clearance(x) for term in self.terms]).amin(dim=0)

    def clearances(self, x: Tensor) -> Tensor:
        return torch.cat([term.clearances(x) for term in self.terms], dim=2)

    def swept_clearance(self, x: Tensor) -> Tensor:
        return torch.stack([term.swept_clearance(x) for term in self.terms]).amin(dim=0)

    def closest(self, x: Tensor, known: Tensor | None = None) -> Tensor:
        for term in self.terms:
            known = term.closest(x, known)
        assert known is not None  # there is a term
        return known

    def barrier(self, x: Tensor) -> Tensor:
        return reduce(add, (term.barrier(x) for term in self.terms))

    def gradient(self, x: Tensor) -> Tensor:
        return reduce(add, (term.gradient(x) for term in self.terms))

    def clearance_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        c, g = zip(*(term.clearance_and_gradient(x) for term in self.terms), strict=True)
        return reduce(torch.minimum, c), reduce(add, g)

    def barrier_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        C, g = zip(*(term.barrier_and_gradient(x) for term in self.terms), strict=True)
        return reduce(add, C), reduce(add, g)

    def shaped(self, shape: Barrier, margin: float = 0.0) -> Constraint:
        return Sum([term.shaped(shape, margin) for term in self.terms])


class PairAvoidance(Constraint):
    """Pairs of bodies that keep their distance: separations w, clearances |w| - r.

    The pairs come first in memory, so that they are taken apart and added up as whole blocks.
    """

    @abstractmethod
    def separations(self, x: Tensor) -> Tensor:
        """w, (pairs, 2 or 3, batch, T)."""

    @abstractmethod
    def onto_bodies(self, dC_dw: Tensor) -> Tensor:
        """The gradient with respect to the bodies' centres, (bodies, 2 or 3, batch, T), of one with respect to w."""

    @abstractmethod
    def gaps(self, d: Tensor) -> Tensor:
        """Clearances d - r of distances d, both (pairs, batch, T)."""

    def clearance(self, x: Tensor) -> Tensor:
        return self.clearances(x).amin(dim=2)

    def clearances(self, x: Tensor) -> Tensor:
        return self.gaps(_length(self.separations(x))).movedim(0, 2)

    def vjp(self, x: Tensor) -> tuple[Tensor, Pullback]:
        w = self.separations(x)
        d = _length(w)

        def pullback(g: Tensor) -> Tensor:
            # d|w|/dw = w / |w|; where two bodies share a point there is none, and this is the subgradient 0.
            dC_dw = (g.movedim(2, 0) / d)[:, None] * w
            return self.robots.pullback(x, self.onto_bodies(dC_dw).permute(2, 3, 0, 1))

        return self.gaps(d).movedim(0, 2), pullback

    def swept_clearance(self, x: Tensor) -> Tensor:
        # The separation goes straight too, w(tau) = w + tau u, and is shortest at tau = -<w, u> / |u|^2.
        w = self.separations(x)
        d, u, w = _length(w), w.diff(dim=3), w[..., :-1]
        # |u| is 0 of bodies that keep their separation.
        tau = (-(w * u).sum(dim=1) / u.square().sum(dim=1).clamp_min(torch.finfo(u.dtype).tiny)).clamp(0, 1)
        # Rounding must not put the closest approach farther away than the ends.
        nearest = torch.minimum(_length(w + tau[:, None] * u), torch.minimum(d[..., :-1], d[..., 1:]))
        return self.gaps(nearest).amin(dim=0)


class Avoidance(PairAvoidance):
    """Given pairs: body points p, separations w = A p - b.

    Args:
        robots: places the body points.
        incidence: A, (pairs, bodies).
        offset: b, (pairs, 2 or 3), or (pairs, 1) where it is 0.
        radius: r, float64 (pairs,): the distance at which a pair touches.
    """

    incidence: Tensor
    offset: Tensor
    radius: Tensor

    def __init__(self, robots: Robots, incidence: Tensor, offset: Tensor, radius: Tensor) -> None:
        super().__init__(robots)
        self.touching = radius
        self.register_buffer("incidence", incidence, persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("radius", radius.to(torch.get_default_dtype()), persistent=False)

    def separations(self, x: Tensor) -> Tensor:
        p = self.robots.points(x).permute(2, 3, 0, 1)
        w = (self.incidence.to(x.dtype) @ p.flatten(1)).view(len(self.incidence), *p.shape[1:])
        return w - self.offset[:, :, None, None]

    def onto_bodies(self, dC_dw: Tensor) -> Tensor:
        A = self.incidence.to(dC_dw.dtype)
        return (A.mT @ dC_dw.flatten(1)).view(A.shape[1], *dC_dw.shape[1:])

    def gaps(self, d: Tensor) -> Tensor:
        return d - self.radius[:, None, None]

    def narrowed(self, margin: float) -> Constraint:
        made = Avoidance(self.robots, self.incidence, self.offset, self.touching + margin)
        made.shape = self.shape
        return made


def _length(w: Tensor) -> Tensor:
    """|w| of w (pairs, 2 or 3, batch, T), (pairs, batch, T).

    In this layout `linalg.vector_norm` and `square` take longer. Of two bodies that share a point it is the root of
    the smallest number, so that w / |w| is 0 and no division by 0.
    """
    squared = reduce(add, (along * along for along in w.unbind(dim=1)))
    return squared.clamp_min(torch.finfo(w.dtype).tiny).sqrt()


class RobotAvoidance(Avoidance):
    """No body of a robot touches one of another robot: their centres keep the sum of their radii.

    >>> from conflow.scene.robots import Discs
    >>> x = torch.tensor([[[0.0, 0.0, 0.5, 0.0]]])  # two discs, half a unit apart
    >>> RobotAvoidance(Discs(2, radius=[0.125, 0.25])).clearance(x).item()
    0.125

    Raises:
        ValueError: there is one robot alone.
    """

    def __init__(self, robots: Robots) -> None:
        if robots.count < 2:
            raise ValueError("one robot: expected two or more that avoid each other")
        i, j = torch.triu_indices(len(robots.owner), len(robots.owner), 1)
        others = robots.owner[i] != robots.owner[j]
        i, j, bodies = i[others], j[others], torch.eye(len(robots.owner))
        super().__init__(robots, bodies[i] - bodies[j], torch.zeros(len(i), 1), robots.radii[i] + robots.radii[j])


class ObstacleAvoidance(Avoidance):
    """Every body stays clear of every obstacle.

    >>> from conflow.scene.robots import Discs
    >>> near = ObstacleAvoidance(Discs(1, radius=0.25), [Obstacle(0.0, 1.0, 0.25)])
    >>> near.clearance(torch.zeros(1, 1, 2)).item()
    0.5

    Raises:
        ValueError: there is no obstacle, or the bodies are in space, where discs are none.
    """

    def __init__(self, robots: Robots, obstacles: Sequence[Obstacle]) -> None:
        if not obstacles:
            raise ValueError("no obstacles: expected one or more to stay clear of")
        axes = robots.points(torch.zeros(1, 1, robots.D)).shape[3]
        if axes != 2 or any(isinstance(one, Ball) for one in obstacles):
            raise ValueError(f"obstacles for bodies in {axes} dimensions: expected bodies in the plane, as discs are")
        bodies, among = len(robots.owner), len(obstacles)
        incidence = torch.eye(bodies).repeat_interleave(among, dim=0)
        offset = torch.tensor([[o.x, o.y] for o in obstacles]).repeat(bodies, 1)
        radius = torch.tensor([o.radius for o in obstacles], dtype=torch.float64).repeat(bodies)
        super().__init__(robots, incidence, offset, robots.radii.repeat_interleave(among) + radius)


class Workspace(Constraint):
    """Every number of a configuration stays within [-1, 1]: c = 1 - |x|; for discs their centres, for arms the joints.

    Each wall counts for itself, at every waypoint: a robot in a corner is pushed away from both.
    """

    def __init__(self, robots: Robots, margin: float = 0.0) -> None:
        super().__init__(robots)
        self.margin, self.shape = margin, replace(self.shape, pairs="all")

    def clearance(self, x: Tensor) -> Tensor:
        return self.clearances(x).amin(dim=2)

    def clearances(self, x: Tensor) -> Tensor:
        return 1 - self.margin - x.abs()

    def vjp(self, x: Tensor) -> tuple[Tensor, Pullback]:
        return self.clearances(x), lambda g: -x.sign() * g

    def swept_clearance(self, x: Tensor) -> Tensor:
        # A box is convex, so between two points inside nothing is nearer to a wall than one of them.
        c = self.clearance(x)
        return torch.minimum(c[:, :-1], c[:, 1:])

    def shaped(self, shape: Barrier, margin: float = 0.0) -> Constraint:
        made = Workspace(self.robots, self.margin + margin)
        made.shape = replace(shape, reduction="sum", pairs="all")
        return made


class SpeedLimit(Constraint):
    """No body moves faster than `limit`: c = limit - |p_{i+1} - p_i| / dt, in workspace units per second.

    At a waypoint the faster of the two steps beside it counts. A trajectory is straight between waypoints, so its speed
    there is that of the step: `swept_clearance` of the slower step is above the clearance of the waypoint between them,
    and the smallest of a trajectory is the same in both.

    Args:
        robots: what moves.
        limit: the largest speed, in workspace units per second.
        dt: seconds from one waypoint to the next, the task's `dt`.
    """

    def __init__(self, robots: Robots, limit: float, dt: float) -> None:
        super().__init__(robots)
        self.limit, self.dt = limit, dt

    def clearance(self, x: Tensor) -> Tensor:
        c = self.swept_clearance(x)
        return torch.minimum(torch.cat([c[:, :1], c], dim=1), torch.cat([c, c[:, -1:]], dim=1))

    def swept_clearance(self, x: Tensor) -> Tensor:
        step = self.robots.points(x).diff(dim=1)
        # Not linalg.vector_norm: its gradient at a robot that stands still is not a number on every version.
        return self.limit - (step.square().sum(dim=3) + SHARED**2).sqrt().amax(dim=2) / self.dt


class AccelerationLimit(Constraint):
    """No body accelerates more than `limit`: c = limit - |p_{i+1} - 2 p_i + p_{i-1}| / dt^2.

    In workspace units per second squared; start and goal count as the waypoint beside them. Velocities jump at
    waypoints, so between two of them the smaller clearance of both stands.

    Args:
        robots: what moves.
        limit: the largest acceleration.
        dt: seconds from one waypoint to the next, the task's `dt`.
    """

    def __init__(self, robots: Robots, limit: float, dt: float) -> None:
        super().__init__(robots)
        self.limit, self.dt = limit, dt

    def clearance(self, x: Tensor) -> Tensor:
        second = self.robots.points(x).diff(dim=1).diff(dim=1)
        c = self.limit - (second.square().sum(dim=3) + SHARED**2).sqrt().amax(dim=2) / self.dt**2
        return torch.cat([c[:, :1], c, c[:, -1:]], dim=1)

    def swept_clearance(self, x: Tensor) -> Tensor:
        c = self.clearance(x)
        return torch.minimum(c[:, :-1], c[:, 1:])
