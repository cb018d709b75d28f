"""Sampling a finished run again."""

from collections.abc import Sequence

from mlflow.entities import Run
from rich.console import Console

from conflow.scene.task import Task
from conflow.scene.tasks import TASKS
from conflow.tracking import code, recording, resume, store
from conflow.training import summary
from conflow.training.config import SPLITS, SplitName
from conflow.training.datamodule import DemonstrationData
from conflow.training.evaluation import EVALUATED_ON_VALIDATION, UNCHANGED, evaluate
from conflow.training.model import ConFlow
from conflow.training.model_file import MODEL_FILE, load_model
from conflow.training.progress import ProgressDisplay


def demonstrations(run: Run, model: ConFlow) -> DemonstrationData:
    """The demonstrations that a run was trained on, generated or read again.

    Raises:
        ConfigError: they are others by now.
    """
    own = None if model.config.data.path is not None and model.config.task in TASKS else model.task
    data = DemonstrationData(model.config, own, training=False)
    resume.check_data(run, data.origin, data.digest)
    return data


def evaluate_again(
    wanted: str, arguments: Sequence[str], split: SplitName, console: Console, task: Task | None = None
) -> None:
    """Sample a finished run anew with other settings, for starts and goals of a split, and add the results to it.

    Metrics go under `evaluate/<settings>/SETTING/...`, where no metric of training stands, those of the validation
    split under `evaluate/val <settings>/SETTING/...`, and the settings beside them into an artifact of that name.
    """
    run = store.find_run(wanted)
    model = load_model(store.artifact(run, MODEL_FILE), arguments, task)
    if differing := code.differing(run.data.tags):
        said = f"{run.info.run_name} was trained by other code, and is sampled by the present: {', '.join(differing)}"
        console.print(said, highlight=False, soft_wrap=True)
    # Of a setting that is given twice the last counts. MLflow allows no = in a metric's name.
    applied = {argument.partition("=")[0]: argument for argument in arguments}
    label = " ".join(argument.replace("=", ":") for argument in sorted(applied.values())) or UNCHANGED
    group = ("evaluate/" if split == "test" else EVALUATED_ON_VALIDATION) + label
    data = demonstrations(run, model)
    with ProgressDisplay(console) as display:
        evaluation = evaluate(model, data.held_out[split], display, split)
    logger = recording.RunLogger(store.client(), run.info.run_id)
    with store.whole():
        logger.store.log_dict(run.info.run_id, model.config.tree(), f"{group}.yaml")
        logger.log_metrics(evaluation.keyed(f"{group}/", baseline=False), 0)
        logger.save()
    title = f"{model.config.preset}/{run.info.run_name}, {label}, {SPLITS[split]} split"
    console.print(summary.results_table(evaluation, title))
