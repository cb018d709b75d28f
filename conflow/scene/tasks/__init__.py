"""Tasks: what is moved, under which constraints, and what it is learned from. One file each."""

from collections.abc import Callable, Mapping

from conflow.scene.task import Task
from conflow.scene.tasks.circle import Circle
from conflow.scene.tasks.crowd import CrowdTask
from conflow.scene.tasks.dense import Basic, Dense
from conflow.scene.tasks.maps import Conveyor, Highways, Room, Shelf
from conflow.scene.tasks.pandas import Pandas
from conflow.scene.tasks.passing import Passing
from conflow.scene.tasks.planar_arms import PlanarArms
from conflow.scene.tasks.random import Random
from conflow.scene.tasks.social import Social
from conflow.scene.tasks.swap import Swap
from conflow.scene.tasks.weave import ScaledWeave, Weave

SWAPS = {"swap": Swap, "passing": Passing, "social": Social}
"""Two robots that swap sides, or more of a file's."""
CROWDS: Mapping[str, Callable[..., CrowdTask]] = {
    "circle": Circle,
    "weave": Weave,
    "scaled_weave": ScaledWeave,
    "random": Random,
    "highways": Highways,
    "conveyor": Conveyor,
    "basic": Basic,
    "dense": Dense,
    "shelf": Shelf,
    "room": Room,
}
"""Many robots, from demonstrations of single ones."""
ARMS: Mapping[str, Callable[..., Task]] = {"planar_arms": PlanarArms, "pandas": Pandas}
"""Two arms that share a workspace."""
TASKS: Mapping[str, Callable[..., Task]] = {**SWAPS, **CROWDS, **ARMS}
"""By the name that `TASK=` chooses."""
