"""ConFlow: flow matching for robot motion with the constraint inside the training.

What programs need has its name here, and is imported when it is asked for: `conflow.train`, `conflow.compare`,
`conflow.Planner`, `conflow.DescentPlanner` without a model, and for tasks of one's own `conflow.Task`,
`conflow.Constraint` and what they are made of.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from conflow.api import compare, train
    from conflow.planner import DescentPlanner, Planner, Plans
    from conflow.scene.constraint import (
        AccelerationLimit,
        Constraint,
        ObstacleAvoidance,
        RobotAvoidance,
        SpeedLimit,
        Workspace,
    )
    from conflow.scene.demonstrations import Demonstrations
    from conflow.scene.robots import Discs, Robots
    from conflow.scene.settings import Obstacle
    from conflow.scene.task import Task

__version__ = "0.1.0"

__all__ = [
    "AccelerationLimit",
    "Constraint",
    "Demonstrations",
    "DescentPlanner",
    "Discs",
    "Obstacle",
    "ObstacleAvoidance",
    "Planner",
    "Plans",
    "RobotAvoidance",
    "Robots",
    "SpeedLimit",
    "Task",
    "Workspace",
    "compare",
    "train",
]

_PLACES = {
    "api": ("compare", "train"),
    "planner": ("DescentPlanner", "Planner", "Plans"),
    "scene.constraint": (
        *("AccelerationLimit", "Constraint", "ObstacleAvoidance", "RobotAvoidance", "SpeedLimit", "Workspace"),
    ),
    "scene.demonstrations": ("Demonstrations",),
    "scene.robots": ("Discs", "Robots"),
    "scene.settings": ("Obstacle",),
    "scene.task": ("Task",),
}


def __getattr__(name: str) -> Any:
    for place, names in _PLACES.items():
        if name in names:
            return getattr(importlib.import_module(f"conflow.{place}"), name)
    raise AttributeError(f"module conflow has no attribute {name!r}")
