"""Going on with an interrupted run: which one, and whether it is the same experiment."""

from mlflow.entities import Run

from conflow.errors import ConfigError
from conflow.tracking import code, store
from conflow.tracking.recording import Experiment

INTERRUPTED = ("KILLED", "FAILED")


def find(wanted: str, config_sha: str) -> Run:
    """The newest interrupted run that is meant by an id, NAME, PRESET/NAME or "latest".

    Where several are meant, as after a machine that trained two has stopped, one of this config is taken first.

    Raises:
        ConfigError: there is none, or it was not interrupted.
    """
    runs = store.runs()
    interrupted = [run for run in runs if run.info.status in INTERRUPTED]
    if meant := [run for run in interrupted if store.means(wanted, run)]:
        return next((run for run in meant if run.data.tags.get("config_sha") == config_sha), meant[0])
    for run in runs:
        if wanted != "latest" and store.means(wanted, run):
            raise ConfigError(f"resume={wanted}: expected an interrupted run, found one that is {run.info.status}")
    raise ConfigError(
        f"resume={wanted}: no such run, {store.expected(wanted, interrupted)}"
        if interrupted
        else f"resume={wanted}: expected an interrupted run, found none"
    )


def check(run: Run, experiment: Experiment, any_code: bool = False) -> None:
    """Refuse to go on with a run as if it were another experiment.

    Args:
        run: the interrupted run.
        experiment: what is asked for.
        any_code: go on also where the code that trains and measures has changed since.

    Raises:
        ConfigError: the run's config, code or demonstrations are others; all differences are listed.
    """
    if run.data.tags["config_sha"] != experiment.tags["config_sha"]:
        raise ConfigError(f"resume={run.info.run_name}: {_differences(run, experiment)}")
    if not any_code and (differing := code.differing(run.data.tags)):
        raise ConfigError(
            f"resume={run.info.run_name}: found other code in {', '.join(differing)}, expected the run's own; "
            "to go on all the same: code=any"
        )
    check_data(run, experiment.dataset, experiment.tags["data_digest"])


def check_data(run: Run, dataset: str, digest: str) -> None:
    """Refuse other demonstrations than those that a run was trained on.

    Raises:
        ConfigError: they are others.
    """
    trained_on = run.data.tags.get("data_digest")
    if trained_on != digest:
        raise ConfigError(
            f"{dataset}: found data {digest}, expected {trained_on}, on which {run.info.run_name} was trained"
        )


def _differences(run: Run, experiment: Experiment) -> str:
    # The run's params, not its config.yaml, which a run that was interrupted early may lack.
    own, asked = run.data.params, experiment.params
    different = [key for key in own | asked if own.get(key) != asked.get(key)]
    found, expected = (", ".join(f"{key}={values.get(key, 'none')}" for key in different) for values in (asked, own))
    return f"found {found}, expected the run's own {expected}"
