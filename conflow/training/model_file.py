"""The model that a run left in a file. Needs torch alone."""

from collections.abc import Sequence
from pathlib import Path

from conflow.errors import ConfigError
from conflow.scene.task import Task, told
from conflow.scene.tasks import TASKS
from conflow.tracking import checkpoint_file
from conflow.tracking.checkpoint_file import CheckpointError
from conflow.training import config as configuration
from conflow.training.build import build_task, made
from conflow.training.model import ConFlow

MODEL_FILE = "model.ckpt"
SAMPLING = ("sample.", "seed")


def load_model(path: Path, arguments: Sequence[str] = (), task: Task | None = None) -> ConFlow:
    """The model that a run left in `model.ckpt`, ready to sample. Reads weights and plain values, runs no code.

    Args:
        path: the file.
        arguments: settings `sample....=value` and `seed=value` to sample with in place of the run's own.
        task: of a run on a task of one's own: the file of a run is not asked which code to run. A run on a task with a
            name here knows its own, and does not take this one. It stays as it is: the model has a copy.

    Raises:
        ConfigError: an argument that is none of these; or a task that is none of the program's, and not given, or does
            not take the run's settings, or is one of other waypoints or robots.
        CheckpointError: the file is damaged or foreign.
    """
    foreign = CheckpointError(f"{path}: expected the {MODEL_FILE} of a run, found a damaged or foreign file")
    checkpoint = checkpoint_file.load(path)
    try:
        described = {"seconds": None} | checkpoint["conflow"]  # which earlier files lack
        T, D, *units = (described[name] for name in ("T", "D", "scale", "offset", "seconds"))
        config, weights = configuration.completed(described["config"]), checkpoint["state_dict"]
    except (KeyError, TypeError):
        raise foreign from None
    config = configuration.from_tree(config)
    if arguments:
        config = configuration.override(config, arguments, SAMPLING)
    if config.task in TASKS:
        task = build_task(config, T, D)
    elif task is None:
        expected = f"expected the file or the object of task {config.task_name}, which no checkpoint holds"
        raise ConfigError(f"task: {expected}; try: task={Path(config.task).name}")
    elif config.of_task:  # a file's, made anew as the run's was
        task = made(type(task), task.name, config.of_task)
    if task.T != T or task.robots.D != D:
        expected = f"expected T={T} and D={D}, as the run of task {config.task_name} has"
        raise ConfigError(f"task={task.name}: found T={task.T} waypoints of D={task.robots.D} numbers, {expected}")
    model = ConFlow(config, told(task, *units))
    try:
        model.load_state_dict(weights)
    except (RuntimeError, TypeError):
        raise foreign from None
    return model.eval()
