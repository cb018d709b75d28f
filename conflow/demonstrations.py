"""`make demonstrations`: files for data.path, from a task's own generator or from tracked people and robots."""

from collections.abc import Mapping
from pathlib import Path

from conflow import commandline
from conflow.errors import ConfigError
from conflow.scene.demonstrations import Demonstrations, save
from conflow.scene.task import demonstrated
from conflow.training import config
from conflow.training.build import build_task


def from_task(options: Mapping[str, str]) -> str:
    """Write what the task of the options demonstrates; what is said of it.

    Raises:
        ConfigError: an option that cannot be used.
        DemonstrationError: the file cannot be written.
    """
    num, seed = commandline.whole(options, "num", 10, 10**5), commandline.whole(options, "seed", 0, 2**32 - 1)
    settings = config.load([f"task={options['task']}"])
    out = _named(options, settings.task_name)
    save(out, demonstrated(build_task(settings), num, seed))
    of_task = "" if settings.task == config.PAPERS_TASK else f"TASK={settings.task} "
    return f"Written: {out}; train on it with: make train {of_task}ARGS=data.path={out}"


def _named(options: Mapping[str, str], name: str) -> str:
    """The file that is asked for, or the one of this name."""
    return f"{name}.npz" if options["out"] == "NAME.npz" else options["out"]


def from_tracks(options: Mapping[str, str]) -> str:
    """Write the windows of a file of tracks in which agents meet; what was found in it.

    Raises:
        ConfigError: an option or the file cannot be used.
        DemonstrationError: the file cannot be written.
    """
    from conflow.recordings import windows  # which needs SciPy and pandas

    opposite = commandline.whole(options, "opposite", 0, 1) == 1
    fps = commandline.number(options, "fps") if options["fps"] else None
    agents, T = commandline.whole(options, "agents", 1, 99), commandline.whole(options, "T", 3, 4096)
    seconds, near = commandline.number(options, "seconds"), commandline.number(options, "near")
    found = windows.read(options["from"], agents, seconds, T, fps, opposite, near)
    out = _named(options, Path(options["from"]).stem)
    if Path(out) == Path(options["from"]):
        raise ConfigError(f"out={out}: expected another file than from")
    save(out, Demonstrations(found.x, None, found.scale, found.offset.tolist(), found.seconds))
    advice = f"train on it with: make train ABLATION=plus ARGS='data.path={out} constraint.radius=...'"
    alone = f"train on it with a task of your own: make train TASK=my_task.py ABLATION=plus ARGS='data.path={out}'"
    return f"{found.summary}\nWritten: {out}; {advice if agents > 1 else alone}"
