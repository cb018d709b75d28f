"""The command line: one thin function a command. What a command needs is imported when it runs."""

import argparse
import sys


def train(arguments: list[str]) -> None:
    """Train, sample, evaluate and track one experiment."""
    from conflow.experiment import config, signals

    signals.raise_on_signals()
    # First of all, and with little imported, so that a mistyped setting is answered at once.
    settings = config.load(arguments)

    from rich.console import Console

    from conflow.experiment.train import train

    console = Console()
    run_id = train(settings, console)
    console.print(f"Run {run_id} is finished. Look at it with: make ui", highlight=False)


def ui(arguments: list[str]) -> None:
    """Serve MLflow's pages of all runs on this machine, on port=5000 unless told otherwise."""
    from conflow.experiment import ui
    from conflow.experiment.config import ConfigError

    port = "5000"
    for argument in arguments:
        key, _, port = argument.partition("=")
        if key != "port" or not port.isdecimal() or not 0 < int(port) < 65536:
            raise ConfigError(f"{argument}: expected port=NUMBER with a number of at most 65535")
    ui.serve(int(port))


COMMANDS = {"train": train, "ui": ui}


def main() -> None:
    """Run one command; exit with 0, with 2 and one line for a known failure, or with 128 + a signal."""
    parser = argparse.ArgumentParser("conflow", description="Constraint-guided flow matching for robot motion.")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, function in COMMANDS.items():
        command = commands.add_parser(name, help=function.__doc__, description=function.__doc__)
        command.add_argument("settings", nargs="*", metavar="key=value", help="settings, see conf/base.yaml")
    arguments = parser.parse_args()
    try:
        COMMANDS[arguments.command](arguments.settings)
    except BaseException as error:
        sys.exit(_exit_code(error))


def _exit_code(error: BaseException) -> int:
    """Known failures end in one line on stderr and an exit code; anything else is a bug and raised."""
    from conflow.experiment.config import ConfigError
    from conflow.experiment.signals import Interrupted
    from conflow.scene.trajectories import DemonstrationError

    if isinstance(error, ConfigError | DemonstrationError):
        print(f"conflow: {error}", file=sys.stderr)
        return 2
    if isinstance(error, Interrupted):
        print(f"conflow: interrupted by {error}", file=sys.stderr)
        return error.exit_code
    raise error


if __name__ == "__main__":
    main()
