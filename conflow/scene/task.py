"""What an experiment is about: robots, what they must keep, and what they learn from."""

import copy
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from conflow.scene.constraint import Constraint, ObstacleAvoidance
from conflow.scene.demonstrations import Demonstrations, typed
from conflow.scene.robots import Robots
from conflow.scene.settings import Box, Obstacle


class Task(ABC):
    """Subclass this to bring a task of one's own; `robots`, `constraints` and `demonstrations` are all it takes.

    All is in workspace units: every number of a configuration lies in [-1, 1], with one common scale for positions, so
    that distances stay distances. The user's coordinates are `scale` x + `offset`; of bodies, where a configuration is
    something else than their positions, `length` p + `origin`.

    Starts and goals that models are asked for are those of demonstrations that were held out.

    Attributes:
        robots: what moves.
        T: waypoints of a trajectory.
        seconds: how long one takes.
        scale: the user's units in a workspace unit: a number, or one for each of D.
        offset: the user's coordinates of x = 0, likewise.
    """

    robots: Robots
    T: int = 32
    seconds: float = 1.0
    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] = 0.0

    @property
    def name(self) -> str:
        """By default that of the class, as in `two_arms` for TwoArms."""
        return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(self).__name__).lower()

    @property
    def dt(self) -> float:
        """Seconds from one waypoint to the next."""
        return self.seconds / (self.T - 1)

    @property
    def length(self) -> float:
        """The user's units of length in one of the bodies': as of configurations, where these are positions."""
        return float(torch.as_tensor(self.scale).flatten()[0])

    @property
    def origin(self) -> tuple[float, float]:
        """The user's coordinates of a body at (0, 0), likewise."""
        x, y = torch.as_tensor(self.offset, dtype=torch.float64).flatten().repeat(2)[:2].tolist()
        return x, y

    @abstractmethod
    def constraints(self) -> Mapping[str, Constraint]:
        """What training keeps, by name: it labels demonstrations, corrects, guides, and is measured."""

    def constraints_at_inference(self) -> Mapping[str, Constraint]:
        """What appears at inference alone, by name: guided around where a setting says so, and measured."""
        return {}

    def avoidance(self, obstacles: Sequence[Obstacle]) -> Constraint:
        """What keeps the robots clear of obstacles that a planner is given."""
        return ObstacleAvoidance(self.robots, obstacles)

    def settings(self) -> Mapping[str, Sequence[str]]:
        """What is evaluated beside `none`, by name: around which constraints sampling is guided.

        By default all that training keeps together, and whatever appears at inference by itself.
        """
        kept = tuple(self.constraints())
        together = kept[0] if len(kept) == 1 else "all"
        return {together: kept, **{name: (name,) for name in self.constraints_at_inference()}}

    @abstractmethod
    def demonstrations(self, num: int, seed: int) -> Tensor | Demonstrations:
        """`num` trajectories x (num, T, D), a function of the seed, with labels if one has them.

        Called by `demonstrated`, which takes NumPy's arrays too.
        """

    def variants(self) -> "Sequence[Task]":
        """Tasks whose demonstrations training sees in turn, such as with fewer robots; the last is like this one."""
        return (self,)

    def of_numbers(self, D: int) -> "Task":
        """The task for configurations of D numbers: this one, or of a crowd the same with as many robots."""
        return self

    def judged(self) -> Mapping[str, Constraint]:
        """All constraints by name, as samples are measured by them."""
        return {**self.constraints(), **self.constraints_at_inference()}

    def obstacles(self) -> Sequence[tuple[float, float, float]]:
        """Discs (x, y, radius) that pictures show."""
        return ()

    def boxes(self) -> Sequence[Box]:
        """Boxes that are always there, and that pictures show."""
        return ()


class SceneTask(Task):
    """A task whose starts and goals come as scenes that have a number, so that planners can be compared on them."""

    @abstractmethod
    def scene(self, count: int, seed: int, index: int) -> Tensor:
        """Start and goal of a scene, a function of (task, count, seed, index) alone, (2, D) for so many robots."""

    def in_scene(self, count: int, seed: int, index: int) -> "SceneTask":
        """The task as it is in a scene, where each has a map of its own; else this one."""
        return self

    @abstractmethod
    def between(self, ends: Tensor, generator: torch.Generator) -> Tensor:
        """A trajectory of each robot's own, as demonstrated, for starts and goals (num, 2, D), (num, T, D)."""


def demonstrated(task: Task, num: int, seed: int) -> Demonstrations:
    """What a task demonstrates, in the types that a file has.

    Raises:
        DemonstrationError: what came is not of that kind.
    """
    made = task.demonstrations(num, seed)
    origin = f"demonstrations of task {task.name}"
    return typed(made if isinstance(made, Demonstrations) else Demonstrations(made), origin)


def told(
    task: Task, scale: float | Sequence[float] | None, offset: float | Sequence[float] | None, seconds: float | None
) -> Task:
    """A copy of the task with the units and the time that are said; of what is None, or the same, it keeps its own.

    An offset for each of the plane's axes holds for every robot.
    """
    made = copy.copy(task)
    if isinstance(offset, Sequence):
        offset = [offset[i % len(offset)] for i in range(task.robots.D)]
    for name, value in {"scale": scale, "offset": offset, "seconds": seconds}.items():
        # A task may compute its own, and takes no other.
        if value is not None and plain(value) != plain(getattr(task, name)):
            setattr(made, name, value)
    return made


def plain(value: float | Sequence[float]) -> Any:
    """A number of a task's, or several, as Python's own: of NumPy's kinds, or torch's, it may be too."""
    return torch.as_tensor(value, dtype=torch.float64).tolist()
