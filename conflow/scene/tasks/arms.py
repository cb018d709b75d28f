"""Two arms that share a workspace and swap sides: what all such tasks have in common.

Another arm takes its constants and its spheres. With this in `three_links.py`, `make train TASK=three_links.py`:

    from math import pi
    import torch
    from conflow.scene.arms import Arms, Base, Body, Chain
    from conflow.scene.tasks.arms import ArmTask

    LINK = [(0.06 + 0.12 * k, 0, 0, 0.05) for k in range(3)]  # (x, y, z, radius) in its link's frame, in metres
    ARM = Chain(
        joints=[(0, 0, 0), (0.4, 0, 0), (0.4, 0, 0)],  # (a, alpha, d) of Craig's modified Denavit-Hartenberg
        low=[-3] * 3,  # radians
        high=[3] * 3,
        speed=[4] * 3,  # radians per second
        bodies=[Body(1, LINK), Body(2, LINK), Body(3, LINK)],
        hand=(0.4, 0, 0),
    )

    class ThreeLinks(ArmTask):
        T = 64
        swept = (-pi / 4, 0, 0), (pi / 4, 0, 0)  # the joints of one arm at start and goal

        def __init__(self):
            super().__init__(Arms([ARM, ARM], [Base(-0.94), Base(0.94, turn=pi)], axes=2))

        def deviations(self, num, generator):  # added halfway to the straight way, (num, arms, joints)
            fold = 1.3 * torch.rand(num, 2, generator=generator).double()
            return torch.stack([0 * fold, fold, -2 * fold], dim=2)
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from conflow.scene.arm_constraints import ArmAvoidance, JointSpeed, SelfAvoidance, SphereAvoidance, Table
from conflow.scene.arms import Arms, Sphere
from conflow.scene.constraint import Constraint, Sum
from conflow.scene.settings import Ball, Obstacle
from conflow.scene.task import SceneTask
from conflow.scene.tasks.curves import uniform
from conflow.scene.tasks.passing import warped

JITTER = 0.06
"""Of every joint at both ends, in radians."""
Known = Literal["training", "inference", "never"]


class ArmTask(SceneTask):
    """Arms whose joints go from `start` to `goal` and evade on the way, independently of each other.

    q(s) = p + s (q - p) + sin(pi s) b, with s a function of time that is another one for each arm, as in `passing`,
    ends p and q jittered, and a deviation b of each arm's own. Configurations are the joints in radians, as shares of
    their limits; lengths are in metres.

    Args:
        robots: the arms, all of the same kind.
        spheres: obstacles (x, y, z, radius).
        obstacles: when they are known: at training and after, at inference alone, or never, which is without them.
        singles: of each arm so many trajectories alone are demonstrated, and joined at random; 0: as many as asked for.

    Raises:
        ValueError: an argument is out of range.
    """

    seconds = 4.0
    robots: Arms

    def __init__(
        self, robots: Arms, spheres: Sequence[Sphere] = (), obstacles: Known = "never", singles: int = 0
    ) -> None:
        if obstacles not in get_args(Known):
            raise ValueError(f"obstacles={obstacles}: expected one of {', '.join(get_args(Known))}")
        if type(singles) is not int or singles < 0:
            raise ValueError(f"singles={singles}: expected a whole number of at least 0")
        self.robots, self.spheres, self.known, self.singles = robots, spheres, obstacles, singles
        self.scale, self.offset = robots.scale.tolist(), robots.offset.tolist()

    @property
    def length(self) -> float:
        return 1.0

    @property
    def origin(self) -> tuple[float, float]:
        return 0.0, 0.0

    @property
    @abstractmethod
    def swept(self) -> tuple[Sequence[float], Sequence[float]]:
        """The joints of one arm at its nominal start and goal, in radians."""

    @abstractmethod
    def deviations(self, num: int, generator: torch.Generator) -> Tensor:
        """b for `num` trajectories of all arms, float64 (num, arms, joints), in radians."""

    def constraints(self) -> Mapping[str, Constraint]:
        robots, count = self.robots, len(self.robots.chains)
        kept: dict[str, Constraint] = {
            "arms": ArmAvoidance(robots),
            "self": Sum([SelfAvoidance(robots, arm) for arm in range(count)]),
            "speed": JointSpeed(robots, self.dt),
        }
        kept |= {"table": Table(robots)} if robots.axes == 3 else {}
        return kept | (self._around() if self.known == "training" else {})

    def constraints_at_inference(self) -> Mapping[str, Constraint]:
        return self._around() if self.known == "inference" else {}

    def avoidance(self, obstacles: Sequence[Obstacle]) -> Constraint:
        spheres = [(one.x, one.y, one.z if isinstance(one, Ball) else 0.0, one.radius) for one in obstacles]
        if any(isinstance(one, Ball) != (self.robots.axes == 3) for one in obstacles):
            raise ValueError(
                f"obstacles for arms in {self.robots.axes} dimensions: expected as many numbers of a place"
            )
        return SphereAvoidance(self.robots, spheres)

    def _around(self) -> dict[str, Constraint]:
        return {"obstacle": SphereAvoidance(self.robots, self.spheres)}

    def settings(self) -> Mapping[str, Sequence[str]]:
        return {"all": tuple(self.constraints()), **{name: (name,) for name in self.constraints_at_inference()}}

    def obstacles(self) -> Sequence[tuple[float, float, float]]:
        return [] if self.known == "never" else [(x, y, radius) for x, y, _, radius in self.spheres]

    def demonstrations(self, num: int, seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)
        q = self.drawn(self.singles or num, generator)
        if self.singles:
            count = len(self.robots.chains)
            of_each = torch.randint(self.singles, (num, 1, count, 1), generator=generator)
            q = q.unflatten(2, (count, -1)).take_along_dim(of_each, dim=0).flatten(2)
        return self.robots.numbers(q).float()

    def drawn(self, num: int, generator: torch.Generator) -> Tensor:
        """Trajectories of all arms' joints in radians, float64 (num, T, D)."""
        return self._ways(self._ends(num, generator), generator)

    def scene(self, count: int, seed: int, index: int) -> Tensor:
        if count != self.robots.count:
            raise ValueError(f"robots={count}: expected {self.robots.count}")
        draw = np.random.default_rng([*self.name.encode(), seed, index])
        generator = torch.Generator().manual_seed(int(draw.integers(2**63)))
        return self.robots.numbers(self._ends(1, generator).flatten(2)[:, 0]).float()

    def between(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        q = self.robots.offset + self.robots.scale * ends.double()
        return self.robots.numbers(self._ways(q.transpose(0, 1).unflatten(2, self._shape), generator)).float()

    @property
    def _shape(self) -> tuple[int, int]:
        """Arms, and joints of each."""
        return len(self.robots.chains), len(self.swept[0])

    def _ends(self, num: int, generator: torch.Generator) -> Tensor:
        """Starts and goals in radians, float64 (2, num, arms, joints)."""
        ends = torch.tensor(self.swept, dtype=torch.float64)
        return ends[:, None, None] + JITTER * uniform(generator, 2, num, *self._shape).double()

    def _ways(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        """Trajectories in radians, float64 (num, T, D), from p to q of ends (2, num, arms, joints)."""
        (p, q), num = ends, ends.shape[1]
        s = warped(num, self.T, generator)[..., None]
        wave = torch.from_numpy(np.sin((torch.pi * s).numpy()))
        wave[:, :, -1] = 0  # sin(pi) in floating point is not
        x = torch.lerp(p[:, :, None], q[:, :, None], s) + wave * self.deviations(num, generator)[:, :, None]
        return x.transpose(1, 2).flatten(2)
