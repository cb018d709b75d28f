"""What a finished run left, and sampling from it again."""

from collections.abc import Sequence
from pathlib import Path

from mlflow.entities import Run
from rich.console import Console

from conflow.experiment import checkpoints, code, record, report, tracking
from conflow.experiment import config as configuration
from conflow.experiment.config import SPLITS, Config, SplitName
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.evaluation import evaluate
from conflow.experiment.module import ConFlow
from conflow.experiment.progress import ProgressDisplay
from conflow.scene.trajectories import DemonstrationError

MODEL_FILE = "model.ckpt"
SAMPLING = ("sample.", "seed")


def load_model(path: Path, arguments: Sequence[str] = ()) -> ConFlow:
    """The model that a run left in `model.ckpt`, ready to sample. Reads weights and plain values, runs no code.

    Args:
        path: the file.
        arguments: settings `sample....=value` and `seed=value` to sample with in place of the run's own.

    Raises:
        ConfigError: an argument that is none of these.
        CheckpointError: the file is damaged or foreign.
    """
    checkpoint = checkpoints.load(path)
    described = checkpoint["conflow"]
    config = configuration.override(configuration.from_tree(described["config"]), arguments, SAMPLING)
    model = ConFlow(config, described["T"], described["D"])
    model.load_state_dict(checkpoint["state_dict"])
    return model.eval()


def demonstrations(run: Run, config: Config) -> DemonstrationData:
    """The demonstrations that a run was trained on, generated or read again.

    Raises:
        DemonstrationError: they are others by now.
    """
    data = DemonstrationData(config)
    check_data(run, data)
    return data


def check_data(run: Run, data: DemonstrationData) -> None:
    """Refuse other demonstrations than those that a run was trained on.

    Raises:
        DemonstrationError: they are others.
    """
    trained_on = run.data.tags.get("data_digest")
    if trained_on != data.digest:
        raise DemonstrationError(
            f"data.path={data.config.data.path}: found data {data.digest}, expected {trained_on}, on which "
            f"{run.info.run_name} was trained"
        )


def evaluate_again(wanted: str, arguments: Sequence[str], split: SplitName, console: Console) -> None:
    """Sample a finished run anew with other settings, for starts and goals of a split, and add the results to it.

    Metrics go under `evaluate/<settings>/SETTING/...`, where no metric of training stands, those of the validation
    split under `evaluate/val <settings>/SETTING/...`, and the settings beside them into an artifact of that name.
    """
    run = tracking.find_run(wanted)
    model = load_model(tracking.artifact(run, MODEL_FILE), arguments)
    if differing := code.differing(run.data.tags):
        said = f"{run.info.run_name} was trained by other code, and is sampled by the present: {', '.join(differing)}"
        console.print(said, highlight=False, soft_wrap=True)
    # MLflow allows no = in a metric's name.
    label = " ".join(argument.replace("=", ":") for argument in sorted(arguments)) or record.UNCHANGED
    group = ("evaluate/" if split == "test" else record.EVALUATED_ON_VALIDATION) + label
    data = demonstrations(run, model.config)
    with ProgressDisplay(console) as display:
        evaluation = evaluate(model, data.held_out[split], display, split)
    logger = tracking.RunLogger(tracking.client(), run.info.run_id)
    with tracking.whole():
        logger.store.log_dict(run.info.run_id, model.config.tree(), f"{group}.yaml")
        logger.log_metrics(evaluation.keyed(f"{group}/", baseline=False), 0)
        logger.save()
    title = f"{run.info.run_name}, {label}, {SPLITS[split]} split"
    console.print(report.results_table(evaluation.results, title))
