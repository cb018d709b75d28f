"""Arms of revolute joints: forward kinematics, and the pullback in closed form, dC/dq_j = a_j . sum (p - o_j) x g_p.

The sum is over the points p that joint j moves, with a_j its axis and o_j a point of it, and g_p = dC/dp.
"""

import math
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from conflow.scene.robots import Robots

Sphere = tuple[float, float, float, float]
"""Centre (x, y, z) in the frame of its link, and radius, in metres."""


@dataclass(frozen=True)
class Body:
    """A part of a link, as spheres; link 0 is the base, link j moves with joint j."""

    link: int
    spheres: Sequence[Sphere]


@dataclass(frozen=True)
class Chain:
    """A serial arm by Craig's modified Denavit-Hartenberg parameters.

    Link j's frame in that of link j - 1 is Rot_x(alpha_j) Trans_x(a_j) Trans_z(d_j) Rot_z(q_j).

    Attributes:
        joints: (a, alpha, d) of each, in metres and radians.
        low, high: limits of the joints, in radians.
        speed: their largest speeds, in radians per second.
        bodies: what can collide, in the order of links; their spheres in the order in which `Arms` has them.
        hand: the last link's point that does the work, (x, y, z) in its frame.
    """

    joints: Sequence[tuple[float, float, float]]
    low: Sequence[float]
    high: Sequence[float]
    speed: Sequence[float]
    bodies: Sequence[Body]
    hand: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Base:
    """Where an arm stands: (x, y, z) in metres, and its turn about the vertical in radians."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    turn: float = 0.0


Result = TypeVar("Result")


class Last(Generic[Result]):
    """What was computed of one tensor, until it changes or another one comes."""

    def __init__(self) -> None:
        self._x: weakref.ref[Tensor] | None = None
        self._version = 0

    def of(self, x: Tensor, compute: Callable[[Tensor], Result]) -> Result:
        """compute(x), the last result if it was of the same x; nothing is kept that gradients are taken of."""
        if x.requires_grad or x.is_inference():
            return compute(x)
        if self._x is None or self._x() is not x or self._version != x._version:
            self._result = compute(x)
            self._x, self._version = weakref.ref(x), x._version
        return self._result


class Arms(Robots):
    """Arms with a chain each, D their joints side by side, as shares of their ranges: q = scale x + offset.

    So the joints' limits are at x = -1 and 1. Bodies are in metres, whatever the joints' scale.

    Args:
        chains: of the arms.
        bases: where each stands.
        axes: 3, or 2 for arms whose joints all turn about z, seen from above.

    Raises:
        ValueError: a chain's lists do not go together.

    Attributes:
        scale, offset: of the joints, float64 (D,) each.
        speed: the largest of each joint, in radians per second, float64 (D,).
        link, local: of every body, the link it moves with, (bodies,), and its centre there, float64 (bodies, 3).
    """

    def __init__(self, chains: Sequence[Chain], bases: Sequence[Base], axes: int = 3) -> None:
        self.chains, self.bases, self.axes = chains, bases, axes
        self.D, self.most = sum(len(one.joints) for one in chains), max(len(one.joints) for one in chains)
        of_joints = [(a, j) for a, chain in enumerate(chains) for j in range(len(chain.joints))]
        self._arm, self._joint = torch.tensor(of_joints).T
        low, high, self.speed = (
            torch.tensor([value for one in chains for value in getattr(one, name)], dtype=torch.float64)
            for name in ("low", "high", "speed")
        )
        self.scale, self.offset = (high - low) / 2, (high + low) / 2
        spheres = [
            (a, body.link, *one) for a, chain in enumerate(chains) for body in chain.bodies for one in body.spheres
        ]
        rows = torch.tensor(spheres, dtype=torch.float64)
        self.owner, self.link = rows[:, 0].long(), rows[:, 1].long()
        self.local, self.radii = rows[:, 2:5], rows[:, 5]
        # Joints that an arm has less than the longest stay at 0 and move nothing.
        self._dh = torch.zeros(3, len(chains), self.most, dtype=torch.float64)
        for a, one in enumerate(chains):
            self._dh[:, a, : len(one.joints)] = torch.tensor(one.joints, dtype=torch.float64).T
        places = [(base.x, base.y, base.z, math.cos(base.turn), math.sin(base.turn)) for base in bases]
        self._places = torch.tensor(places, dtype=torch.float64)
        self._last: Last[Tensor] = Last()

    def __deepcopy__(self, memo: dict[int, object]) -> "Arms":
        return self  # nothing that counts ever changes

    @property
    def traced(self) -> Sequence[int]:
        return [int((self.owner == arm).nonzero()[-1]) for arm in range(len(self.chains))]

    def joints(self, x: Tensor) -> Tensor:
        """The joints q in radians, (..., D), of configurations x."""
        return self.scale.to(x) * x + self.offset.to(x)

    def numbers(self, q: Tensor) -> Tensor:
        """The configurations x of joints q in radians, (..., D)."""
        return (q - self.offset.to(q)) / self.scale.to(q)

    def frames(self, x: Tensor) -> Tensor:
        """The frames of all links of configurations x (batch, T, D), (links, 4, 3, arms, batch T).

        Of the second axis the first three are the frame's axes X, Y and Z, and the last is its origin, in metres.
        Those of the last x are kept, since several constraints ask for them one after the other.
        """
        return self._last.of(x, self._frames)

    def _frames(self, x: Tensor) -> Tensor:
        q = x.new_zeros(len(self.chains), self.most, x.shape[0] * x.shape[1])
        q[self._arm, self._joint] = self.joints(x).flatten(0, 1).mT
        cos, sin = q.cos(), q.sin()
        a, alpha, d = self._dh.to(x)[..., None]
        across, along = alpha.sin(), alpha.cos()
        x0, y0, z0, c, s = self._places.to(x).T[..., None].expand(-1, -1, q.shape[2])
        zero, one = torch.zeros_like(c), torch.ones_like(c)
        X, Y, Z, o = (torch.stack(axis) for axis in ((c, s, zero), (-s, c, zero), (zero, zero, one), (x0, y0, z0)))
        frames = [torch.stack([X, Y, Z, o])]
        for j in range(self.most):
            Y, Z = along[:, j] * Y + across[:, j] * Z, along[:, j] * Z - across[:, j] * Y
            o = o + a[:, j] * X + d[:, j] * Z
            X, Y = cos[:, j] * X + sin[:, j] * Y, cos[:, j] * Y - sin[:, j] * X
            frames.append(torch.stack([X, Y, Z, o]))
        return torch.stack(frames)

    def points(self, x: Tensor) -> Tensor:
        return self._placed(self.frames(x), x)

    def hands(self, x: Tensor) -> Tensor:
        """Where the arms' hands are, (batch, T, arms, 2 or 3), in metres."""
        frames, hand = (
            self.frames(x),
            torch.tensor([[*one.hand, 1.0] for one in self.chains], dtype=torch.float64).to(x),
        )
        last = [frames[len(chain.joints), :, :, a] for a, chain in enumerate(self.chains)]
        p = torch.stack([torch.einsum("k,kcn->cn", hand[a], frame) for a, frame in enumerate(last)])
        return p.permute(2, 0, 1).unflatten(0, x.shape[:2])[..., : self.axes]

    def pullback(self, x: Tensor, g: Tensor) -> Tensor:
        p = self.points(x)
        if self.axes == 2:
            p, g = (F.pad(one, (0, 1)) for one in (p, g))
        # Force and moment about the world's origin, on every link and then on all that each joint moves.
        arms, links = len(self.chains), self.most + 1
        on_links = x.new_zeros(2, x.shape[0] * x.shape[1], arms * links, 3)
        wrench = torch.stack([g, torch.linalg.cross(p, g)]).flatten(1, 2)
        which = (self.owner * links + self.link).to(x.device)
        on_links = on_links.index_add(2, which, wrench).unflatten(2, (arms, links))
        force, moment = on_links.permute(0, 3, 4, 2, 1).flip(1).cumsum(dim=1).flip(1)[:, 1:]
        axis, origin = self.frames(x)[1:, 2:].unbind(dim=1)
        # sum (p - o_j) x g_p, with o_j taken out of the sum.
        torque = (axis * (moment - torch.linalg.cross(origin, force, dim=1))).sum(dim=1)
        return self._numbers(torque.transpose(0, 1), x)

    def moved(self, g: Tensor) -> Tensor:
        turned = g.new_zeros(*g.shape[:2], len(self.chains), self.most + 1, dtype=torch.bool)
        turned[..., self._arm, self._joint + 1] = g != 0
        return turned.cummax(dim=3).values[..., self.owner, self.link]

    def pull(self, x: Tensor, arm: Tensor, link: Tensor, p: Tensor, g: Tensor) -> Tensor:
        """As `pullback`, of one g (batch T, 3) for each waypoint, at a point p (batch T, 3) of a link of an arm."""
        each = torch.arange(len(p), device=p.device)
        axis, origin = (self.frames(x)[1:, k, :, arm, each] for k in (2, 3))
        moved = torch.arange(1, self.most + 1, device=p.device)[:, None] <= link
        torque = (axis * torch.linalg.cross(p.mT - origin, g.mT.expand_as(origin), dim=1)).sum(dim=1) * moved
        of_all = torque.new_zeros(len(self.chains), self.most, len(p))
        of_all[arm, :, each] = torque.mT
        return self._numbers(of_all, x)

    def _numbers(self, torque: Tensor, x: Tensor) -> Tensor:
        """dC/dx (batch, T, D) of dC/dq (arms, joints, batch T)."""
        return (self.scale.to(x) * torque[self._arm, self._joint].mT).unflatten(0, x.shape[:2])

    def levers(self, arm: Tensor, link: Tensor, local: Tensor) -> Tensor:
        """How far points of links are from the axes of the joints that move them, at most, and 0 from others, (D, n).

        The sum of lengths along the chain, from a joint's origin to a point at `local`, (n, 3) in metres, on a link of
        an arm, `link` and `arm` (n,): whatever the joints' angles are.
        """
        a, _, d = self._dh
        along = F.pad((a.square() + d.square()).sqrt().cumsum(dim=1), (1, 0))  # to each link's origin, (arms, links)
        lever = along[arm, link] + torch.linalg.vector_norm(local, dim=1) - along[self._arm, self._joint + 1][:, None]
        return lever * ((self._arm[:, None] == arm) & (self._joint[:, None] < link))

    def seen_from_base(self, sphere: Sphere) -> Sphere:
        """A sphere that stands in the workspace, in the frame of the first arm's base."""
        x, y, z, radius = sphere
        x0, y0, z0, cos, sin = self._places[0].tolist()
        return cos * (x - x0) + sin * (y - y0), cos * (y - y0) - sin * (x - x0), z - z0, radius

    def _placed(self, frames: Tensor, x: Tensor) -> Tensor:
        """The bodies' centres of so many frames, (batch, T, bodies, axes)."""
        local = F.pad(self.local, (0, 1), value=1.0).to(x)
        p = [
            torch.einsum("sk,kcn->nsc", local[(self.owner == a) & (self.link == link)], frames[link, :, :, a])
            for a, link in sorted({*zip(self.owner.tolist(), self.link.tolist(), strict=True)})
        ]
        return torch.cat(p, dim=1).unflatten(0, x.shape[:2])[..., : self.axes]
