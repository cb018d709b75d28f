"""Going on with an interrupted run: which one, and whether it is the same experiment."""

from mlflow.entities import Run

from conflow.experiment import tracking
from conflow.experiment.config import Config, ConfigError, flatten, nearest
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.finished import check_data

INTERRUPTED = ("KILLED", "FAILED")


def find(wanted: str) -> Run:
    """The newest run with this id or name, or the newest that was interrupted for "latest".

    Raises:
        ConfigError: there is none, or it was not interrupted.
    """
    runs = tracking.runs()
    known = sorted({str(run.info.run_name) for run in runs if run.info.status in INTERRUPTED})
    for run in runs:
        if wanted in (run.info.run_id, run.info.run_name) or (wanted == "latest" and run.info.status in INTERRUPTED):
            if run.info.status in INTERRUPTED:
                return run
            raise ConfigError(f"resume={wanted}: expected an interrupted run, found one that is {run.info.status}")
    raise ConfigError(
        f"resume={wanted}: no such run, expected latest, an id or a name{nearest(wanted, known)}"
        if known
        else f"resume={wanted}: expected an interrupted run, found none"
    )


def check(run: Run, config: Config, data: DemonstrationData) -> None:
    """Refuse to go on with a run as if it were another experiment.

    Raises:
        ConfigError: the run's config is another; all differences are listed.
        DemonstrationError: its demonstrations are.
    """
    if run.data.tags["config_sha"] != config.sha():
        raise ConfigError(f"resume={run.info.run_name}: {_differences(run, config)}")
    check_data(run, data)


def _differences(run: Run, config: Config) -> str:
    # The run's params, not its config.yaml, which a run that was interrupted early may lack.
    own, asked = run.data.params, {key: str(value) for key, value in flatten(config.identity()).items()}
    different = [key for key in own | asked if own.get(key) != asked.get(key)]
    found, expected = (", ".join(f"{key}={values.get(key, 'none')}" for key in different) for values in (asked, own))
    return f"found {found}, expected the run's own {expected}"


def find_cell(config: Config, digest: str) -> str | None:
    """The id of the newest interrupted run of this very experiment, if there is one."""
    for run in tracking.runs(config_sha=config.sha(), data_digest=digest):
        if run.info.status in INTERRUPTED:
            return str(run.info.run_id)
    return None
