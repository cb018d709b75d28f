"""Tasks: what is moved, under which constraints, and what it is learned from. One file each."""

from conflow.scene.tasks.passing import Passing
from conflow.scene.tasks.social import Social
from conflow.scene.tasks.swap import Swap

TASKS = {"swap": Swap, "passing": Passing, "social": Social}
"""By the name that `TASK=` chooses."""
