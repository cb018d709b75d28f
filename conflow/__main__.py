"""The command line: one thin function a command. What a command needs is imported when it runs."""

import argparse
import os
import re
import sys
import textwrap
import traceback
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console


def train(arguments: list[str]) -> None:
    """Train, sample, evaluate and track one experiment, split=val to print; or go on with one: resume=RUN, code=any."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    # First of all, and with little imported, so that a mistyped setting is answered at once.
    options, rest = config.options(arguments, {"resume": "", "code": "same", "split": "val"})
    any_code, split = _any_code(options), config.held_out(options)
    settings = config.load(rest)
    config.check_training(settings)

    from conflow.experiment.train import train

    console = _console()
    run_id = train(settings, console, options["resume"], any_code, split)
    console.print(f"Run {run_id} is finished. Look at it with: make ui", highlight=False)


def ablations(arguments: list[str]) -> None:
    """Train every ablation for every seed, what is not finished yet, and compare: seeds="0 1 2" ablations= jobs=1.

    Methods are chosen by the validation split: split=val.
    """
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    defaults = {"seeds": "0 1 2", "ablations": " ".join(config.names("ablation")), "jobs": "1", "preset": "quick"}
    options, settings = config.options(arguments, defaults | {"code": "same", "split": "val"})
    any_code, split = _any_code(options), config.held_out(options)
    jobs = config.whole(options, "jobs", 1, 1024)
    for key in ("seeds", "ablations"):
        if not options[key].split():
            raise config.ConfigError(f"{key}={options[key]}: expected at least one")
    wanted = [f"preset={options['preset']}", *settings]
    config.check_training(config.load(wanted))

    from conflow.experiment import compare, grid, report

    console = _console()
    failed = grid.run(options["ablations"].split(), options["seeds"].split(), wanted, jobs, console, any_code)
    report.render([compare.collect(options["preset"], settings, split)], "table", console)
    if failed:
        raise config.ConfigError(f"{failed} cells failed; the same command tries them again")


def _any_code(options: "Mapping[str, str]") -> bool:
    """Whether runs of other code than the present are to be taken for those that are asked for."""
    from conflow.experiment.config import ConfigError

    if options["code"] not in ("same", "any"):
        raise ConfigError(f"code={options['code']}: expected same or any")
    return options["code"] == "any"


def evaluate(arguments: list[str]) -> None:
    """Sample a finished run again with other settings, and add the results: run=latest split=val sample....= seed=."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    options, settings = config.options(arguments, {"run": "latest", "split": "val"})
    split = config.held_out(options)

    from conflow.experiment.finished import evaluate_again

    evaluate_again(options["run"], settings, split, _console())


def compare(arguments: list[str]) -> None:
    """Print tables and claims of finished runs: preset=quick split=val format=table; reference=1: published ones."""
    from conflow.experiment import compare, config, report

    options, settings = config.options(arguments, {"preset": "quick", "format": "table", "reference": "0", "split": ""})
    of_record = bool(config.whole(options, "reference", 0, 1))
    options["split"] = options["split"] or ("test" if of_record else "val")
    split = config.held_out(options)
    if of_record and split != "test":
        raise config.ConfigError(f"split={split}: expected test with reference=1, which is what records publish")
    config.load([f"preset={options['preset']}", *settings])  # of a mistyped one there are no runs either

    form = report.checked_format(options["format"])
    found = compare.collect_reference() if of_record else [compare.collect(options["preset"], settings, split)]
    report.render(found, form, _console())


def reference(arguments: list[str]) -> None:
    """Write the numbers of a preset's newest finished runs into runs/reference/runs/, a file each: preset=quick."""
    from conflow.experiment import config

    options, _ = config.options(arguments, {"preset": "quick"}, settings=False)
    config.load([f"preset={options['preset']}"])

    from conflow.experiment import record

    paths = record.publish(options["preset"])
    print(f"Written: {len(paths)} files in {record.FOLDER}")


def sample(arguments: list[str]) -> None:
    """Plan from start= to goal= and draw it: run=latest out=plans.npz num=64 seed=0 guidance=both obstacle=x,y,r."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    defaults = {"run": "latest", "out": "plans.npz", "num": "64", "guidance": "both", "seed": "0"}
    options, _ = config.options(arguments, {"start": "", "goal": "", "obstacle": ""} | defaults, settings=False)
    # The one option that may be given several times.
    obstacles = [value for key, value in map(config.split, arguments) if key == "obstacle"]
    for key in ("start", "goal"):
        if not options[key]:
            example = 'make sample START="-0.8,0,0.8,0" GOAL="0.8,0,-0.8,0"'
            raise config.ConfigError(f"{key}: expected the robots' positions, found none; try: {example}")

    from conflow import planner

    print(planner.sample(options, obstacles))


def figures(arguments: list[str]) -> None:
    """Draw the pictures of finished runs into runs/figures/: split=val, run=latest, or NAME,NAME,... to compare too."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    options, _ = config.options(arguments, {"run": "latest", "split": "val"}, settings=False)
    split = config.held_out(options)

    from conflow.experiment.figures import gallery

    gallery.draw(options["run"].split(","), split, _console())


def explain(arguments: list[str]) -> None:
    """Draw why the covariant correction works, and what fewer collisions cost the published runs: preset=quick."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    options, _ = config.options(arguments, {"preset": "quick"}, settings=False)
    settings = config.load([f"preset={options['preset']}"])

    from conflow.experiment.figures import explain, gallery

    console = _console()
    gallery.draw_front(console)
    explain.draw(settings, console)


def demonstrations(arguments: list[str]) -> None:
    """Write demonstrations of another kind, for data.path: kind=passing, or social, out=KIND.npz num=3000 seed=0."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    defaults = {"kind": "passing", "out": "KIND.npz", "num": "3000", "seed": "0"}
    options, _ = config.options(arguments, defaults, settings=False)
    num, seed = config.whole(options, "num", 10, 10**5), config.whole(options, "seed", 0, 2**32 - 1)

    from conflow.scene.trajectories import KINDS, save

    kind = options["kind"]
    if kind not in KINDS:
        offer = config.nearest(kind, list(KINDS))
        raise config.ConfigError(f"kind={config.brief(kind)}: expected {' or '.join(KINDS)}{offer}")
    out = f"{kind}.npz" if options["out"] == defaults["out"] else options["out"]
    save(out, KINDS[kind](num, seed=seed))
    print(f"Written: {out}; train on it with: make train ARGS=data.path={out}")


def bench(arguments: list[str]) -> None:
    """Measure how fast everything is, beside what a user would take instead: format=table; reference=1: of record."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    options, _ = config.options(arguments, {"format": "table", "reference": "0"}, settings=False)
    of_record = bool(config.whole(options, "reference", 0, 1))

    from conflow.experiment import report

    form = report.checked_format(options["format"])

    from conflow.bench import suite, table

    console = _console()
    path = suite.REFERENCE if of_record else suite.measure(console)
    table.render(suite.Bench.read(path), form, console)
    print(f"{'Read from' if of_record else 'Written'}: {path}", file=sys.stderr)


def ui(arguments: list[str]) -> None:
    """Serve MLflow's pages of all runs on this machine: port=5000."""
    from conflow.experiment import config

    options, _ = config.options(arguments, {"port": "5000"}, settings=False)
    port = config.whole(options, "port", 1, 65535)

    from conflow.experiment import ui

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
    "bench": bench,
    "ui": ui,
}


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, _line(f"{message}; try: {self.prog} --help") + "\n")


def main() -> None:
    """Run one command; exit with 0, with 2 and one line for a known failure, or with 128 + a signal."""
    from conflow.experiment import signals

    parser = Parser("conflow", description="Constraint-guided flow matching for robot motion.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, function in COMMANDS.items():
        command = commands.add_parser(name, help=function.__doc__, description=function.__doc__)
        command.add_argument(
            "settings", nargs="*", metavar="key=value", help="options, or settings, see conf/base.yaml"
        )
    arguments = parser.parse_args()
    try:
        COMMANDS[arguments.command](arguments.settings)
        signals.check()
        sys.stdout.flush()  # what the output says to this is said here, not after the end
    except BaseException as error:
        sys.exit(_exit_code(error))


def _console() -> "Console":
    from rich.console import Console

    # Without a terminal rich assumes 80 columns, in which the tables would be all line breaks.
    console = Console()
    return console if console.is_terminal else Console(width=140)


def _exit_code(error: BaseException) -> int:
    """Known failures end in one line on stderr and an exit code; anything else is a bug and raised."""
    from conflow.experiment import signals

    if interrupted := signals.arrived():
        print(f"conflow: interrupted by {interrupted}", file=sys.stderr)
        return interrupted.exit_code
    reason = _reason(error)
    if reason is None:
        raise error
    print(_line(reason), file=sys.stderr)
    try:
        sys.stdout.flush()
    except OSError:  # nor will it take at the end what it did not take now
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 2


def _reason(error: BaseException) -> str | None:
    """What a known failure says; None of any other."""
    from conflow.experiment.config import ConfigError
    from conflow.scene.trajectories import DemonstrationError

    if isinstance(error, ConfigError | DemonstrationError):
        return str(error)
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
