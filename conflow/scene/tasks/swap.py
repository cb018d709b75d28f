"""The paper's task: two robots swap sides, D+ and D- (paper: "Task Description")."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from conflow.scene.constraint import Constraint, ObstacleAvoidance, RobotAvoidance
from conflow.scene.errors import DemonstrationError
from conflow.scene.robots import Discs
from conflow.scene.settings import Obstacle
from conflow.scene.task import Task
from conflow.scene.tasks.curves import ends, harmonics, trajectories, uniform


class Swap(Task):
    """Discs in the plane that avoid each other, and at inference an obstacle too.

    Args:
        T: waypoints.
        D: two numbers for each disc.
        radius: the distance of two discs' centres at which they touch.
        obstacle: what appears at inference.
        judged_radius: the distance below which samples count as collisions; None: `radius`.
        judged_object_radius: from the obstacle's centre, where the centre of a disc counts as in it; None: where the
            two touch.
        amplitudes, jitter: of `swap`.
    """

    def __init__(
        self,
        T: int = 32,
        D: int = 4,
        radius: float = 0.3,
        obstacle: Obstacle | None = None,
        judged_radius: float | None = None,
        judged_object_radius: float | None = None,
        amplitudes: Sequence[float] = (0.93, 0.11),
        jitter: float = 0.04,
    ) -> None:
        if D < 4 or D % 2:
            raise DemonstrationError(
                f"x has shape (N, {T}, {D}), expected (N, T, D) with D = 2 per robot, two robots or more, which avoid "
                f"each other in task {self.name}; one robot alone can have a task of its own"
            )
        self.T, self.robots = T, Discs.of(D, radius / 2)
        self.judges = Discs.of(D, (judged_radius or radius) / 2)
        self.obstacle, self.judged_object_radius = obstacle or Obstacle(), judged_object_radius
        self.amplitudes, self.jitter = amplitudes, jitter

    def constraints(self) -> Mapping[str, Constraint]:
        return {"robot": RobotAvoidance(self.robots)}

    def constraints_at_inference(self) -> Mapping[str, Constraint]:
        return {"object": ObstacleAvoidance(self.robots, [self.obstacle])}

    def settings(self) -> Mapping[str, Sequence[str]]:
        return {"robot": ("robot",), "obstacle": ("object",)}

    def judged(self) -> Mapping[str, Constraint]:
        found = {**super().judged(), "robot": RobotAvoidance(self.judges)}
        if self.judged_object_radius is not None:
            points, disc = Discs.of(self.robots.D, 0), replace(self.obstacle, radius=self.judged_object_radius)
            found["object"] = ObstacleAvoidance(points, [disc])
        return found

    def obstacles(self) -> Sequence[tuple[float, float, float]]:
        return [(self.obstacle.x, self.obstacle.y, self.obstacle.radius)]

    def demonstrations(self, num: int, seed: int) -> Tensor:
        return swap(num, self.T, self.amplitudes, self.jitter, seed)


def swap(
    num: int, T: int = 32, amplitudes: Sequence[float] = (0.93, 0.11), jitter: float = 0.04, seed: int = 0
) -> Tensor:
    """Two robots that swap sides, x (num, T, 4) as (x1, y1, x2, y2).

    Each robot goes along its straight line from p to q with a deviation orthogonal to travel,
    x(s) = p + s (q - p) + n sum_k a_k sin(k pi s), a_k uniform in +-amplitudes[k-1]. The coordinates of p and q
    are jittered uniformly by +-jitter. Of the defaults' trajectories 30 % come closer than 0.3.
    """
    generator = torch.Generator().manual_seed(seed)
    a = uniform(generator, num, 2, len(amplitudes)) * torch.tensor(amplitudes)
    p, q = ends(num, jitter, generator)
    s = torch.linspace(0, 1, T, dtype=torch.float64).float()
    return trajectories(p, q, s, a @ harmonics(len(amplitudes), T).float())
