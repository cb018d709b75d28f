"""The command line: one thin function a command. What a command needs is imported when it runs."""

import argparse
import os
import re
import sys
import textwrap
import traceback
from typing import TYPE_CHECKING, NoReturn

from conflow import errors

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from types import ModuleType

    from rich.console import Console

    from conflow.scene.task import Task


def train(arguments: list[str]) -> None:
    """Train, sample, evaluate and track one experiment, split=val to print; or go on with one: resume=RUN, code=any."""
    from conflow import commandline
    from conflow.training import config, memory

    # First of all, and with little imported, so that a mistyped setting is answered at once.
    options, rest = commandline.options(arguments, {"resume": "", "code": "same", "split": "val"})
    any_code, split = _any_code(options), commandline.held_out(options)
    settings = config.load(rest)
    memory.check_training(settings)

    from conflow.figures.workspace import of_training
    from conflow.training.train import train

    terminal = console()
    run_id = train(settings, terminal, options["resume"], any_code, split, of_training)
    terminal.print(f"Run {run_id} is finished. Look at it with: make ui", highlight=False)


def ablations(arguments: list[str]) -> None:
    """Train every ablation for every seed, what is not finished yet, and compare: seeds="0 1 2" ablations= jobs=1.

    Methods are chosen by the validation split: split=val. On a Ray cluster: cluster=auto|host:port cpus=1 gpus=0.
    """
    from conflow import commandline
    from conflow.training import config, memory

    defaults = {"seeds": "0 1 2", "ablations": " ".join(config.names("ablation")), "jobs": "1", "preset": "quick"}
    defaults |= {"cluster": "", "cpus": "1", "gpus": "0", "code": "same", "split": "val"}
    options, settings = commandline.options(arguments, defaults)
    any_code, split = _any_code(options), commandline.held_out(options)
    jobs, cpus, gpus = (
        commandline.whole(options, key, low, 1024) for key, low in (("jobs", 1), ("cpus", 1), ("gpus", 0))
    )
    for key in ("seeds", "ablations"):
        if not options[key].split():
            raise errors.ConfigError(f"{key}={options[key]}: expected at least one")
    wanted = [f"preset={options['preset']}", *settings]
    memory.check_training(config.load(wanted))

    from conflow.results import comparison, printing

    terminal = console()
    cells = options["ablations"].split(), options["seeds"].split(), wanted
    if options["cluster"]:
        cluster = _cluster(options["cluster"])
        failed = cluster.run(*cells, options["cluster"], cpus, gpus, terminal, any_code)
    else:
        from conflow.grid import local

        failed = local.run(*cells, jobs, terminal, any_code)
    printing.render([comparison.collect(options["preset"], settings, split)], "table", terminal)
    if failed:
        raise errors.ConfigError(f"{failed} cells failed; the same command tries them again")


def _cluster(address: str) -> "ModuleType":
    """What trains a grid with Ray, which most people do without."""
    try:
        from conflow.grid import cluster
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise errors.ConfigError(
            f"cluster={address}: found no Ray, expected the extra `cluster`; try: pip install '.[cluster]'"
        ) from None
    return cluster


def _any_code(options: "Mapping[str, str]") -> bool:
    """Whether runs of other code than the present are to be taken for those that are asked for."""
    if options["code"] not in ("same", "any"):
        raise errors.ConfigError(f"code={options['code']}: expected same or any")
    return options["code"] == "any"


def evaluate(arguments: list[str]) -> None:
    """Sample a finished run again with other settings, and add the results: run=latest split=val sample....= seed=."""
    from conflow import commandline

    options, settings = commandline.options(arguments, {"run": "latest", "split": "val", "task": ""})
    split = commandline.held_out(options)

    from conflow.training.reload import evaluate_again

    evaluate_again(options["run"], settings, split, console(), _task(options))


def compare(arguments: list[str]) -> None:
    """Print tables and claims of finished runs: preset=quick split=val format=table; reference=1: published ones."""
    from conflow import commandline
    from conflow.results import comparison, printing
    from conflow.training import config

    options, settings = commandline.options(
        arguments, {"preset": "quick", "format": "table", "reference": "0", "split": ""}
    )
    of_record = bool(commandline.whole(options, "reference", 0, 1))
    options["split"] = options["split"] or ("test" if of_record else "val")
    split = commandline.held_out(options)
    if of_record and split != "test":
        raise errors.ConfigError(f"split={split}: expected test with reference=1, which is what records publish")
    config.load([f"preset={options['preset']}", *settings])  # of a mistyped one there are no runs either

    form = printing.checked_format(options["format"])
    found = comparison.collect_reference() if of_record else [comparison.collect(options["preset"], settings, split)]
    printing.render(found, form, console())


def reference(arguments: list[str]) -> None:
    """Write the numbers of a preset's newest finished runs into runs/reference/runs/, a file each: preset=quick."""
    from conflow import commandline
    from conflow.training import config

    options, _ = commandline.options(arguments, {"preset": "quick"}, settings=False)
    config.load([f"preset={options['preset']}"])

    from conflow.results import records

    paths = records.publish(options["preset"])
    print(f"Written: {len(paths)} files in {records.FOLDER}")


def sample(arguments: list[str]) -> None:
    """Plan from start= to goal= and draw: run=latest out=plans.npz num=64 seed=0 guidance=all obstacle=x,y,r via=s,x

    With run=none without a model, for task=NAME.
    """
    from conflow import commandline

    defaults = {"run": "latest", "out": "plans.npz", "num": "64", "guidance": "all", "seed": "0", "task": ""}
    own = {"start": "", "goal": "", "obstacle": "", "via": ""} | defaults
    options, _ = commandline.options(arguments, own, settings=False)
    # The options that may be given several times.
    several = {name: commandline.repeated(arguments, name) for name in ("obstacle", "via")}
    for key in ("start", "goal"):
        if not options[key]:
            example = 'make sample START="-0.8,0,0.8,0" GOAL="0.8,0,-0.8,0"'
            raise errors.ConfigError(f"{key}: expected the robots' positions, found none; try: {example}")

    from conflow.sample import sample

    print(sample(options, several["obstacle"], several["via"], _task(options)))


def _task(options: "Mapping[str, str]") -> "Task | None":
    """The task of one's own that the option names; whatever else it names, a run knows itself."""
    from pathlib import Path

    from conflow.training import config
    from conflow.training.build import task_of_file

    return task_of_file(Path(options["task"])) if config.is_file(options["task"]) else None


def figures(arguments: list[str]) -> None:
    """Draw the pictures of finished runs into runs/figures/: split=val, run=latest, or NAME,NAME,... to compare too."""
    from conflow import commandline

    options, _ = commandline.options(arguments, {"run": "latest", "split": "val", "task": ""}, settings=False)
    split = commandline.held_out(options)

    from conflow.figures import gallery

    gallery.draw(options["run"].split(","), split, console(), _task(options))


def explain(arguments: list[str]) -> None:
    """Draw why the covariant correction works, and what fewer collisions cost the published runs: preset=quick."""
    from conflow import commandline
    from conflow.training import config

    options, _ = commandline.options(arguments, {"preset": "quick"}, settings=False)
    settings = config.load([f"preset={options['preset']}"])

    from conflow.figures import explain, gallery

    terminal = console()
    gallery.draw_front(terminal)
    explain.draw(settings, terminal)


def demonstrations(arguments: list[str]) -> None:
    """Write demonstrations for data.path, of a task= or from=TRACKS.csv agents=2 seconds=6 T=32: out= num= seed=0."""
    from conflow import commandline

    defaults = {"task": "swap", "from": "", "out": "NAME.npz", "num": "3000", "seed": "0"}
    tracked = {"agents": "2", "seconds": "6", "T": "32", "fps": "", "opposite": "1", "near": "2"}
    options, _ = commandline.options(arguments, defaults | tracked, settings=False)

    from conflow.demonstrations import from_task, from_tracks

    print(from_tracks(options) if options["from"] else from_task(options))


def planbench(arguments: list[str]) -> None:
    """Solve scenes of robots or arms with models and without: task=weave n=28 scenes=64 run=NAME,NAME seed=1 num=16."""
    from conflow import commandline

    defaults = {"task": "weave", "n": "", "scenes": "64", "run": "", "seed": "1", "num": "16", "limit": "5"}
    defaults |= {"guided": "0", "format": "table", "reference": "0", "out": "runs/planbench"}
    options, settings = commandline.options(arguments, defaults)
    options["run"] = options["run"] or f"{options['task']}-plus-s0"

    from conflow.planbench import planbench

    planbench(options, settings, console())


def ui(arguments: list[str]) -> None:
    """Serve MLflow's pages of all runs on this machine: port=5000."""
    from conflow import commandline

    options, _ = commandline.options(arguments, {"port": "5000"}, settings=False)
    port = commandline.whole(options, "port", 1, 65535)

    from conflow.tracking import ui

    ui.serve(port)


COMMANDS = {
    "train": train,
    "ablations": ablations,
    "evaluate": evaluate,
    "compare": compare,
    "reference": reference,
    "sample": sample,
    "figures": figures,
    "explain": explain,
    "demonstrations": demonstrations,
    "planbench": planbench,
    "ui": ui,
}


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, _line(f"{message}; try: {self.prog} --help") + "\n")


def main() -> None:
    """Run one command; exit with 0, with 2 and one line for a known failure, or with 128 + a signal."""
    parser = Parser("conflow", description="Constraint-guided flow matching for robot motion.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, function in COMMANDS.items():
        command = commands.add_parser(name, help=function.__doc__, description=function.__doc__)
        command.add_argument(
            "settings", nargs="*", metavar="key=value", help="options, or settings, see conf/base.yaml"
        )
    arguments = parser.parse_args()
    guarded(COMMANDS[arguments.command], arguments.settings)


def guarded(command: "Callable[[list[str]], None]", arguments: list[str]) -> None:
    """Run a command; end the process with one line where it fails in a known way."""
    from conflow.tracking import signals

    signals.raise_on_signals()
    try:
        command(arguments)
        signals.check()
        sys.stdout.flush()  # what the output says to this is said here, not after the end
    except BaseException as error:
        signals.ending()
        sys.exit(_exit_code(error))


def console() -> "Console":
    """Where commands print; of several processes the first one."""
    from rich.console import Console

    from conflow.tracking import ranks

    if ranks.rank():
        return Console(quiet=True)
    # Without a terminal rich assumes 80 columns, in which the tables would be all line breaks.
    found = Console()
    return found if found.is_terminal else Console(width=140)


def _exit_code(error: BaseException) -> int:
    """Known failures end in one line on stderr and an exit code; anything else is a bug and raised.

    Of several processes that train together the first one says what all of them know.
    """
    from conflow.scene.errors import DemonstrationError
    from conflow.tracking import ranks, signals

    if interrupted := signals.arrived():
        if not ranks.rank():
            print(f"conflow: interrupted by {interrupted}", file=sys.stderr)
        return interrupted.exit_code
    reason = _reason(error)
    if reason is None:
        raise error
    if not ranks.rank():
        print(_line(reason), file=sys.stderr)
    elif not isinstance(error, errors.ConfigError | DemonstrationError) and not ranks.lost(error):
        print(_line(f"rank {ranks.rank()}: {reason}"), file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:  # nor will it take at the end what it did not take now
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 2


def _reason(error: BaseException) -> str | None:
    """What a known failure says; None of any other."""
    from conflow.scene.errors import DemonstrationError
    from conflow.tracking import ranks

    if isinstance(error, errors.ConfigError | DemonstrationError):
        return str(error)
    if ranks.lost(error):
        return f"lost another of the {ranks.world()} processes that train together; try: ... resume=latest"
    text = textwrap.shorten(str(error), 200, placeholder=" ...")
    if isinstance(error, MemoryError) or re.search("can't allocate memory|out of memory", text):  # says torch
        return f"memory: {text or 'used up'}, expected a smaller network, batch, or number of trajectories"
    if _of_store(error):
        uri = os.environ.get("MLFLOW_TRACKING_URI")
        store = f"MLFLOW_TRACKING_URI={uri}" if uri else "runs/mlflow.db"
        found = textwrap.shorten(str(error).partition("[SQL")[0], 200, placeholder=" ...")
        # Without the password.
        return re.sub(r"(?<=//)[^/@\s]+@", "", f"{store}: {found}, expected a store that MLflow can use")
    if isinstance(error, OSError) and error.strerror:
        where = "output" if error.filename is None else error.filename
        return f"{where}: {error.strerror}, expected a file or folder that can be used"
    return None


def _of_store(error: BaseException) -> bool:
    """Whether MLflow or its database failed, which are not imported here: most commands end before they are."""
    libraries = ("mlflow", "sqlalchemy")
    if type(error).__module__.partition(".")[0] in libraries:
        return True
    frames = [frame.f_globals.get("__name__", "") for frame, _ in traceback.walk_tb(error.__traceback__)]
    # A folder that cannot be made, or a database's driver that is not installed.
    through = any(name.partition(".")[0] in libraries for name in frames)
    return isinstance(error, OSError | ModuleNotFoundError) and through


def _line(reason: str) -> str:
    """One line for the terminal, in which nothing acts on it."""
    shown = (c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(reason.split()))
    return f"conflow: {''.join(shown)}"


if __name__ == "__main__":
    main()
