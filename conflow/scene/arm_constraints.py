"""Constraints on arms: apart from each other, from themselves, from obstacles and the table, and not too fast."""

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from conflow.scene.arms import Arms, Body, Last, Sphere
from conflow.scene.constraint import PARTS, SHARED, Constraint, Pullback

PART = 4
"""Spheres of a body that are looked at together, at most."""
FAR, FAR_FROM_ITSELF = 0.2, 0.05
"""Metres beyond which gaps are not measured."""
WAYPOINTS = 512
"""At which pairs of bodies are looked for at a time: what that takes stays in the cache."""
ROWS, HALVINGS = 128, PARTS.bit_length() - 1
"""Trajectories that are swept at a time, and how often what is between two waypoints is halved: into PARTS."""
SEPARATE = 3
"""Links of an arm that are so far apart along it may touch; nearer ones are held apart by their joints' limits."""


class Bounded(Constraint):
    """A constraint on where bodies are, whose clearance changes by at most sum_j slope_j |dq_j| as joints turn by dq.

    Attributes:
        slope: in metres per radian, float64 (D,).
    """

    robots: Arms
    slope: Tensor

    def gaps(self, x: Tensor) -> Tensor:
        """c as `closest` needs it, (batch, T): a constraint that does not measure far ones looks farther here."""
        return self.clearance(x)

    def swept_clearance(self, x: Tensor) -> Tensor:
        # By subdividing, but few at a time: of a thousand all that it takes would be gigabytes.
        return torch.cat([super(Bounded, self).swept_clearance(rows) for rows in x.split(ROWS)])

    def closest(self, x: Tensor, known: Tensor | None = None) -> Tensor:
        return torch.cat(
            [
                self._closest(rows, None if known is None else known[i : i + len(rows)])
                for i, rows in zip(range(0, len(x), ROWS), x.split(ROWS), strict=True)
            ]
        )

    def _closest(self, x: Tensor, known: Tensor | None) -> Tensor:
        """By halving what is between two waypoints, as often as `swept_clearance` divides it, where it may matter.

        From c and c' at its ends, which a gap on the way is at most `change` away from in sum, it is at least
        (c + c' - change) / 2.
        """
        gaps = self.gaps(x)
        found = gaps.amin(dim=1)
        found = found if known is None else torch.minimum(found, known)
        row = torch.arange(len(x), device=x.device).repeat_interleave(x.shape[1] - 1)
        p, q, c, c_ = (one.flatten(0, 1) for one in (x[:, :-1], x[:, 1:], gaps[:, :-1], gaps[:, 1:]))
        change = (q - p).abs() @ (self.slope * self.robots.scale).to(x)
        for _ in range(HALVINGS):
            may = (c + c_ - change) / 2 < found[row]
            row, p, q, c, c_, change = (one[may] for one in (row, p, q, c, c_, change))
            if not len(row):
                break
            middle = (p + q) / 2
            between = self.gaps(middle[None])[0]
            found = found.scatter_reduce(0, row, between, "amin")
            halves = (row, row), (p, middle), (middle, q), (c, between), (between, c_), (change / 2, change / 2)
            row, p, q, c, c_, change = map(torch.cat, halves)
        return found


class NearestPair(Bounded):
    """Parts of arms keep apart: c is the gap between the nearest spheres of any two of them, |p - q| - r - r'.

    Gaps beyond `far` are not measured, and count as that. Of all pairs of spheres few are looked at: a ball around each
    part says how near its spheres are at least. At every waypoint the pair of parts for which that is smallest is
    measured, and then those that may be nearer still. The result is that of all pairs.

    Args:
        robots: the arms.
        bodies: (arm, body) each; obstacles are bodies on a base.
        apart: whether two of them, (arm, body, arm, body), have to keep apart.
        far: in metres.
    """

    arm: Tensor
    link: Tensor
    i: Tensor
    j: Tensor

    def __init__(
        self,
        robots: Arms,
        bodies: Sequence[tuple[int, Body]],
        apart: Callable[[int, Body, int, Body], bool],
        far: float = FAR,
    ) -> None:
        super().__init__(robots)
        self.far = far
        parts = [(arm, Body(body.link, part)) for arm, body in bodies for part in _parts(body.spheres)]
        arm, link = torch.tensor([(arm, body.link) for arm, body in parts]).T
        # Parts with fewer spheres than another have their first one more often.
        rows = [[*body.spheres, *[body.spheres[0]] * (PART - len(body.spheres))] for _, body in parts]
        spheres = torch.tensor(rows, dtype=torch.float64)
        centre = (spheres[..., :3].amin(dim=1) + spheres[..., :3].amax(dim=1)) / 2
        self.local = F.pad(torch.cat([centre[:, None], spheres[..., :3]], dim=1), (0, 1), value=1.0)
        self.radius = spheres[..., 3]
        reach = (torch.linalg.vector_norm(spheres[..., :3] - centre[:, None], dim=2) + self.radius).amax(dim=1)
        kept = torch.tensor(
            [[i < j and apart(*one, *other) for j, other in enumerate(parts)] for i, one in enumerate(parts)]
        )
        i, j = kept.any(dim=1).nonzero()[:, 0], kept.any(dim=0).nonzero()[:, 0]
        # What need not keep apart is as good as infinitely far.
        self.reach = (reach[:, None] + reach).where(kept, -torch.inf)[i][:, j]
        # A joint that moves both of two parts as one does not change their gap.
        lever = robots.levers(arm.repeat_interleave(PART), link.repeat_interleave(PART), spheres[..., :3].flatten(0, 1))
        lever = lever.unflatten(1, (-1, PART)).amax(dim=2)
        one_alone = (lever[:, :, None] > 0) ^ (lever[:, None] > 0)
        self.slope = (torch.maximum(lever[:, :, None], lever[:, None]) * (one_alone & kept)).amax(dim=(1, 2))
        # What was found on an accelerator looks up in these.
        for name, index in {"arm": arm, "link": link, "i": i, "j": j}.items():
            self.register_buffer(name, index, persistent=False)
        self._last: Last[Contact] = Last()

    def clearance(self, x: Tensor) -> Tensor:
        return self._nearest(x).c.view(x.shape[:2])

    def vjp(self, x: Tensor) -> tuple[Tensor, Pullback]:
        near, robots = self._nearest(x), self.robots

        def pullback(g: Tensor) -> Tensor:
            # c = |p - q| - r - r' grows as p goes along u = (p - q) / |p - q|, and q against it.
            away = g.reshape(-1, 1) * near.u
            return robots.pull(x, self.arm[near.i], self.link[near.i], near.p, away) + robots.pull(
                x, self.arm[near.j], self.link[near.j], near.q, -away
            )

        return near.c.view(*x.shape[:2], 1), pullback

    def gaps(self, x: Tensor) -> Tensor:
        if self.far >= FAR:
            return self.clearance(x)
        farther = copy.copy(self)
        farther.far, farther._last = FAR, Last()
        return farther.clearance(x)

    def _closest(self, x: Tensor, known: Tensor | None) -> Tensor:
        far = x.new_full(x.shape[:1], self.far)
        return super()._closest(x, far if known is None else known.clamp(max=self.far))

    def _nearest(self, x: Tensor) -> "Contact":
        return self._last.of(x, self._found)

    def _found(self, x: Tensor) -> "Contact":
        found = [self._among(part) for part in self.robots.frames(x).split(WAYPOINTS, dim=4)]
        return Contact(*map(torch.cat, zip(*found, strict=True)))

    def _among(self, frames: Tensor) -> "Contact":
        """The nearest pair at each of N waypoints."""
        on = frames[self.link, :, :, self.arm]
        # Every part's centre and its spheres', (parts, 1 + PART, 3, N).
        points = (self.local.to(on) @ on.flatten(2)).unflatten(2, (3, -1))
        n, pair, least = self._near(points[:, 0].detach())
        bound = least.new_full(points.shape[3:], self.far)
        at_first = bound.scatter_reduce(0, n, least, "amin")
        first, c = least == at_first[n], points.new_full(bound.shape, self.far)
        promising = self._measured(points, pair[first], n[first])
        bound = bound.scatter_reduce(0, n[first], promising.c.detach(), "amin")
        rest = ~first & (least < bound[n])
        others = self._measured(points, pair[rest], n[rest])
        found, n = Contact(*map(torch.cat, zip(promising, others, strict=True))), torch.cat([n[first], n[rest]])
        c = c.scatter_reduce(0, n, found.c, "amin")
        nearest = (found.c == c[n]) & (found.c < self.far)
        i, j, p, q, u = (
            one.new_zeros(len(c), *one.shape[1:]).index_put((n[nearest],), one[nearest]) for one in found[1:]
        )
        # What is not a number has no near pair, and no clearance either.
        return Contact(c + 0 * points[:, 0].sum(dim=(0, 1)), i, j, p, q, u)

    def _near(self, centre: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Waypoints n, pairs of parts that may be nearer than `far` there, and their least gaps, (M,) each."""
        squares = centre.new_zeros(len(self.i), len(self.j), centre.shape[2])
        for along in centre.unbind(dim=1):  # one axis after the other: all at once would leave the cache
            apart = along[self.i, None] - along[self.j]
            squares = squares.addcmul_(apart, apart)
        reach, squares = self.reach.flatten().to(centre), squares.flatten(0, 1)
        pair, n = (squares < (reach + self.far).clamp_min(0).square()[:, None]).nonzero(as_tuple=True)
        return n, pair, squares[pair, n].sqrt() - reach[pair]

    def _measured(self, points: Tensor, pair: Tensor, n: Tensor) -> "Contact":
        """The nearest spheres of so many pairs of parts at waypoints n, all (M,)."""
        i, j, N = self.i[pair // len(self.j)], self.j[pair % len(self.j)], points.shape[3]
        # Whole rows of (3, PART, M): what is near in memory is taken together.
        each = N * torch.arange(3 * PART + 3, device=n.device).unflatten(0, (-1, 3)).mT[:, 1:, None]
        p, q = (points.flatten()[each + (one * (3 * PART + 3) * N + n)] for one in (i, j))
        radius = self.radius.to(points).mT
        gaps = _length(p[:, :, None] - q[:, None]) - (radius[:, i][:, None] + radius[:, j])
        c, spheres = gaps.flatten(0, 1).min(dim=0)
        p, q = (
            one.take_along_dim(sphere.expand(3, 1, -1), dim=1)[:, 0]
            for one, sphere in ((p, spheres // PART), (q, spheres % PART))
        )
        u = (p - q) / _length(p - q).clamp_min(SHARED)
        return Contact(c, i, j, p.mT, q.mT, u.mT)


class Contact(NamedTuple):
    """The nearest spheres at N waypoints.

    Attributes:
        c: the gap between them, (N,).
        i, j: their bodies, (N,).
        p, q: their centres, (N, 3).
        u: the unit vector from q to p, (N, 3); 0 where they share their centre.
    """

    c: Tensor
    i: Tensor
    j: Tensor
    p: Tensor
    q: Tensor
    u: Tensor


def _length(w: Tensor) -> Tensor:
    """|w| of w (3, ...): `linalg.vector_norm` takes ten times as long along the first axis."""
    x, y, z = w
    return (x * x + y * y + z * z).sqrt()


def _bodies(robots: Arms) -> list[tuple[int, Body]]:
    return [(arm, body) for arm, chain in enumerate(robots.chains) for body in chain.bodies]


def _parts(spheres: Sequence[Sphere]) -> list[Sequence[Sphere]]:
    """As few parts as can be, of at most PART spheres each, as they follow each other."""
    count = -(-len(spheres) // PART)
    return [spheres[k * len(spheres) // count : (k + 1) * len(spheres) // count] for k in range(count)]


def _other(a: int, _: Body, b: int, __: Body) -> bool:
    return a != b


def _separate(_: int, body: Body, __: int, other: Body) -> bool:
    return other.link - body.link >= SEPARATE


def _in_the_way(_: int, body: Body, __: int, other: Body) -> bool:
    return body.link > 0 and other.link == 0


class ArmAvoidance(NearestPair):
    """No body of an arm touches one of another arm.

    Raises:
        ValueError: there is one arm alone.
    """

    def __init__(self, robots: Arms) -> None:
        if len(robots.chains) < 2:
            raise ValueError("one arm: expected two or more that avoid each other")
        super().__init__(robots, _bodies(robots), _other)


class SelfAvoidance(NearestPair):
    """No body of an arm touches one of its own that is SEPARATE links away or more.

    Args:
        robots: the arms.
        arm: which of them.
    """

    def __init__(self, robots: Arms, arm: int) -> None:
        own = [one for one in _bodies(robots) if one[0] == arm]
        super().__init__(robots, own, _separate, FAR_FROM_ITSELF)


class SphereAvoidance(NearestPair):
    """No body of an arm, but for its base, touches a sphere that stands in the workspace; of arms in the plane a disc.

    Args:
        robots: the arms.
        spheres: (x, y, z, radius) each, in metres.

    Raises:
        ValueError: there is no sphere.
    """

    def __init__(self, robots: Arms, spheres: Sequence[Sphere]) -> None:
        if not spheres:
            raise ValueError("no spheres: expected one or more to stay clear of")
        # A sphere that stands still is one on the first arm's base.
        moving = [one for one in _bodies(robots) if one[1].link]
        standing = [(0, Body(0, [robots.seen_from_base(sphere)])) for sphere in spheres]
        super().__init__(robots, [*moving, *standing], _in_the_way)


class Table(Bounded):
    """Nothing that its first joint lifts touches the table the arms stand on: c is the smallest z - r of a sphere.

    What is before the second joint turns about the vertical, and stays as high as it is.
    """

    lifted: Tensor

    def __init__(self, robots: Arms, height: float = 0.0) -> None:
        super().__init__(robots)
        self.height = height
        self.register_buffer("lifted", (robots.link > 1).nonzero()[:, 0], persistent=False)
        self.slope = robots.levers(robots.owner, robots.link, robots.local)[:, self.lifted].amax(dim=1)

    def clearance(self, x: Tensor) -> Tensor:
        return self._gaps(x).amin(dim=0).view(x.shape[:2])

    def vjp(self, x: Tensor) -> tuple[Tensor, Pullback]:
        robots = self.robots
        c, lowest = self._gaps(x).min(dim=0)
        body = self.lifted[lowest]

        def pullback(g: Tensor) -> Tensor:
            local = F.pad(robots.local.to(x)[body], (0, 1), value=1.0)
            link, owner = robots.link.to(x.device)[body], robots.owner.to(x.device)[body]
            on = robots.frames(x)[link, :, :, owner, torch.arange(len(body), device=x.device)]
            up = F.pad(g.reshape(-1, 1), (2, 0))
            return robots.pull(x, owner, link, torch.einsum("nk,nkc->nc", local, on), up)

        return c.view(*x.shape[:2], 1), pullback

    def _gaps(self, x: Tensor) -> Tensor:
        """z - r of every sphere, (spheres, batch T)."""
        robots = self.robots
        link, owner = robots.link.to(x.device)[self.lifted], robots.owner.to(x.device)[self.lifted]
        local = F.pad(robots.local.to(x)[self.lifted], (0, 1), value=1.0)
        z = torch.einsum("sk,skn->sn", local, robots.frames(x)[link, :, 2, owner])
        return z - (self.height + robots.radii.to(x)[self.lifted])[:, None]


class JointSpeed(Constraint):
    """No joint turns faster than it can: c = min_j 1 - |q_{j,i+1} - q_{j,i}| / (dt limit_j), as a share of its limit.

    At a waypoint the faster of the two steps beside it counts; between two waypoints the speed is that of the step.

    Args:
        robots: the arms, which know their limits.
        dt: seconds from one waypoint to the next, the task's `dt`.
    """

    robots: Arms

    def __init__(self, robots: Arms, dt: float) -> None:
        super().__init__(robots)
        self.longest = dt * robots.speed / robots.scale

    def clearance(self, x: Tensor) -> Tensor:
        c = self.swept_clearance(x)
        return torch.minimum(torch.cat([c[:, :1], c], dim=1), torch.cat([c, c[:, -1:]], dim=1))

    def swept_clearance(self, x: Tensor) -> Tensor:
        return 1 - (x.diff(dim=1) / self.longest.to(x)).abs().amax(dim=2)
