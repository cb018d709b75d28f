"""Going on with an interrupted run: which one, and whether it is the same experiment."""

from mlflow.entities import Run

from conflow.experiment import code, tracking
from conflow.experiment.config import Config, ConfigError, flatten
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.finished import check_data

INTERRUPTED = ("KILLED", "FAILED")


def find(wanted: str) -> Run:
    """The newest interrupted run that is meant by an id, NAME, PRESET/NAME or "latest".

    Raises:
        ConfigError: there is none, or it was not interrupted.
    """
    runs = tracking.runs()
    interrupted = [run for run in runs if run.info.status in INTERRUPTED]
    for run in interrupted:
        if tracking.means(wanted, run):
            return run
    for run in runs:
        if wanted != "latest" and tracking.means(wanted, run):
            raise ConfigError(f"resume={wanted}: expected an interrupted run, found one that is {run.info.status}")
    raise ConfigError(
        f"resume={wanted}: no such run, {tracking.expected(wanted, interrupted)}"
        if interrupted
        else f"resume={wanted}: expected an interrupted run, found none"
    )


def check(run: Run, config: Config, data: DemonstrationData, any_code: bool = False) -> None:
    """Refuse to go on with a run as if it were another experiment.

    Args:
        run: the interrupted run.
        config: what is asked for.
        data: its demonstrations.
        any_code: go on also where the code that trains and measures has changed since.

    Raises:
        ConfigError: the run's config or code is another; all differences are listed.
        DemonstrationError: its demonstrations are.
    """
    if run.data.tags["config_sha"] != config.sha():
        raise ConfigError(f"resume={run.info.run_name}: {_differences(run, config)}")
    if not any_code and (differing := code.differing(run.data.tags)):
        raise ConfigError(
            f"resume={run.info.run_name}: found other code in {', '.join(differing)}, expected the run's own; "
            "to go on all the same: code=any"
        )
    check_data(run, data)


def _differences(run: Run, config: Config) -> str:
    # The run's params, not its config.yaml, which a run that was interrupted early may lack.
    own, asked = run.data.params, {key: str(value) for key, value in flatten(config.identity()).items()}
    different = [key for key in own | asked if own.get(key) != asked.get(key)]
    found, expected = (", ".join(f"{key}={values.get(key, 'none')}" for key in different) for values in (asked, own))
    return f"found {found}, expected the run's own {expected}"
