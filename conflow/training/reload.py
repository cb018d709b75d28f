"""What a finished run left, and sampling from it again."""

from collections.abc import Sequence
from pathlib import Path

from mlflow.entities import Run
from rich.console import Console

from conflow.tracking import checkpoints, code, recording, resume, store
from conflow.training import config as configuration
from conflow.training import summary
from conflow.training.config import SPLITS, Config, SplitName
from conflow.training.datamodule import DemonstrationData
from conflow.training.evaluation import EVALUATED_ON_VALIDATION, UNCHANGED, evaluate
from conflow.training.module import ConFlow
from conflow.training.progress import ProgressDisplay

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
        ConfigError: they are others by now.
    """
    data = DemonstrationData(config)
    resume.check_data(run, data.origin, data.digest)
    return data


def evaluate_again(wanted: str, arguments: Sequence[str], split: SplitName, console: Console) -> None:
    """Sample a finished run anew with other settings, for starts and goals of a split, and add the results to it.

    Metrics go under `evaluate/<settings>/SETTING/...`, where no metric of training stands, those of the validation
    split under `evaluate/val <settings>/SETTING/...`, and the settings beside them into an artifact of that name.
    """
    run = store.find_run(wanted)
    model = load_model(store.artifact(run, MODEL_FILE), arguments)
    if differing := code.differing(run.data.tags):
        said = f"{run.info.run_name} was trained by other code, and is sampled by the present: {', '.join(differing)}"
        console.print(said, highlight=False, soft_wrap=True)
    # MLflow allows no = in a metric's name.
    label = " ".join(argument.replace("=", ":") for argument in sorted(arguments)) or UNCHANGED
    group = ("evaluate/" if split == "test" else EVALUATED_ON_VALIDATION) + label
    data = demonstrations(run, model.config)
    with ProgressDisplay(console) as display:
        evaluation = evaluate(model, data.held_out[split], display, split)
    logger = recording.RunLogger(store.client(), run.info.run_id)
    with store.whole():
        logger.store.log_dict(run.info.run_id, model.config.tree(), f"{group}.yaml")
        logger.log_metrics(evaluation.keyed(f"{group}/", baseline=False), 0)
        logger.save()
    title = f"{run.info.run_name}, {label}, {SPLITS[split]} split"
    console.print(summary.results_table(evaluation.results, title))
