"""What the commands do, from Python: train an experiment, compare the finished ones."""

from typing import TYPE_CHECKING, Any

from conflow.errors import ConfigError
from conflow.training import config

if TYPE_CHECKING:
    import pandas as pd

    from conflow.scene.task import Task


def train(task: "Task | str" = config.PAPERS_TASK, ablation: str = "cgp", **settings: Any) -> str:
    """Train, sample, evaluate and track one experiment, as `make train` does; the id of its MLflow run.

    What an object was made with is no part of the record: runs of MyTask(1.0) and of MyTask(2.0) count as the same
    experiment, and `compare` shows the newest of them. Of a file it is, as `task="my_task.py", task__limit=2.0`.

    Args:
        task: a task of one's own, or the name of any, or the file of one.
        ablation: the method.
        settings: `preset`, `seed`, and any other; those with a dot in their name with two underscores in its place, as
            in `train__max_steps=100`, or, of a name or a file, `task__robots=20` of what the task is made with.

    Raises:
        ConfigError: a setting that cannot be used.
        DemonstrationError: demonstrations that cannot be used.
    """
    chosen = config.load([*_task(task), f"ablation={ablation}", *config.arguments_of(settings)])

    from rich.console import Console

    from conflow.figures.workspace import of_training
    from conflow.tracking import ranks
    from conflow.training.build import of_object
    from conflow.training.memory import check_training
    from conflow.training.train import train

    own = None if isinstance(task, str) else of_object(task, chosen)
    check_training(chosen)
    return train(chosen, Console(quiet=ranks.rank() > 0), draw=of_training, task=own)


def compare(
    task: "Task | str" = config.PAPERS_TASK, split: config.SplitName = "val", **settings: Any
) -> "pd.DataFrame":
    """The tables of `make compare`, a row for each number: of the newest finished run of every ablation and seed.

    Columns are table, row, column, value, its interval over seeds low and high, count, trajectories, and the rest of
    `results.tables.Cell`.

    Args:
        task: as in `train`.
        split: whose starts and goals the models were given.
        settings: with which the runs were trained, `preset` among them.

    Raises:
        ConfigError: there is no such run.
    """
    import pandas as pd

    from conflow.results.comparison import collect
    from conflow.training.build import of_object

    arguments = [*_task(task), *config.arguments_of(settings)]
    chosen = config.load(arguments)
    if not isinstance(task, str):
        of_object(task, chosen)
    found = collect(chosen.preset, [one for one in arguments if not one.startswith("preset=")], split)
    return pd.DataFrame(found.cells)


def _task(task: "Task | str") -> list[str]:
    """The argument that names a task. One of a file is known by it, so that runs from there and from here are equal.

    Raises:
        ConfigError: an object of a named task, whose settings it does not tell.
    """
    if isinstance(task, str):
        return [f"task={task}"]
    from conflow.scene.tasks import TASKS
    from conflow.training.build import file_of, settings_of

    for name, kind in TASKS.items():
        if type(task) is kind:
            own = [f"task__{one}=..." for one in settings_of(kind)] if name not in config.SWAPS else []
            expected = f'expected its name, task="{name}"' + f", and {', '.join(own)}" * bool(own)
            raise ConfigError(f"task={type(task).__name__}(...): {expected}")
    return [f"task={file_of(task)}"]
