"""The paper's task in a few words, for tests: its settings, its constraints, its model."""

from collections.abc import Sequence

from conflow.scene.constraint import Barrier, Constraint, ObstacleAvoidance, RobotAvoidance
from conflow.scene.robots import Discs
from conflow.scene.settings import Obstacle
from conflow.training.build import build_task, labels
from conflow.training.config import Config
from conflow.training.module import Training

SETTINGS = ("none", "robot", "obstacle")
TWO = Discs(2)


def keep_apart(count: int = 2, radius: float = 0.3, barrier: Barrier | None = None) -> Constraint:
    """Discs whose centres keep a distance."""
    return RobotAvoidance(Discs(count, radius / 2)).shaped(barrier or Barrier())


def keep_clear(
    count: int, obstacles: Sequence[Obstacle], robot_radius: float, barrier: Barrier | None = None
) -> Constraint:
    """Discs that stay clear of obstacles."""
    return ObstacleAvoidance(Discs(count, robot_radius), obstacles).shaped(barrier or Barrier())


def model_of(config: Config, T: int = 32, D: int = 4) -> Training:
    """The model of these settings for trajectories (T, D), which can be trained."""
    return Training(config, build_task(config, T, D))


def label(config: Config, D: int = 4) -> Constraint:
    """What labels demonstrations of these settings."""
    return labels(config, build_task(config, D=D))
