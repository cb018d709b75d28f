"""One experiment from its config to a finished MLflow run."""

import logging
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import lightning
from lightning import Trainer
from mlflow.entities import Run
from rich.console import Console

from conflow.scene.task import Task
from conflow.tracking import carried, checkpoints, recording, resume, store
from conflow.tracking.checkpoints import AtomicCheckpointIO, Checkpoints
from conflow.training import summary
from conflow.training.build import fitted, labels
from conflow.training.callbacks import TrainingLog, TrainingProgress, ValidationSamples
from conflow.training.config import SPLITS, Config, SplitName, flatten
from conflow.training.datamodule import DemonstrationData
from conflow.training.evaluation import Evaluation, evaluate
from conflow.training.forecast import Forecast
from conflow.training.model import ConFlow
from conflow.training.model_file import MODEL_FILE
from conflow.training.module import DivergedError, Training
from conflow.training.progress import ProgressDisplay

Draw = Callable[[ConFlow, DemonstrationData, Evaluation, Path], None]
"""Writes pictures of a trained model, its demonstrations and its samples of the validation split into a folder."""


def train(
    config: Config,
    console: Console,
    wanted: str = "",
    any_code: bool = False,
    split: SplitName = "val",
    draw: Draw | None = None,
    task: Task | None = None,
) -> str:
    """Train, sample, evaluate and log one experiment; the id of its run.

    Both splits that are held out are measured and logged: methods are chosen by the one and reported by the other.

    Args:
        config: the experiment.
        console: for progress and results.
        wanted: an interrupted run of this experiment to go on with: its id, NAME, PRESET/NAME, or "latest".
        any_code: go on with it also where other code began it.
        split: the one whose results are printed.
        draw: makes pictures for the run.
        task: what it is about; by default what the config names.

    Raises:
        DemonstrationError: before anything is tracked.
        ConfigError: there is no such run, or it is of another experiment or of other code.
        CheckpointError: a checkpoint could not be written.
        DivergedError: a loss or gradient was not finite.
    """
    lightning.seed_everything(config.seed, verbose=False)
    data = DemonstrationData(config, task)
    model = Training(fitted(config, data.known), data.task)
    model.fit(data.known)
    interrupted = resume.find(wanted) if wanted else None
    asked = experiment(config, data)
    checkpoint = _continued(interrupted, asked, config, console, any_code) if interrupted else None
    console.print(understood(data), highlight=False, soft_wrap=True)
    with recording.start(asked, interrupted) as logger:
        run_id = str(logger.run_id)
        if config.source.fit:
            kernel = model.config.source
            logger.log_metrics({"source/length_scale": kernel.length_scale, "source/sigma_f": kernel.sigma_f}, 0)
        with ProgressDisplay(console) as display:
            loop = trainer(config, logger, data, display)
            try:
                loop.fit(model, data, ckpt_path=checkpoint)
            except DivergedError as error:
                raise DivergedError(f"{error}; {_last_good(run_id)}") from None
            # Lightning leaves the model on the CPU.
            model.eval().to(loop.strategy.root_device)
            tested = evaluate(model, data.held_out["test"], display, "test")
            validated = evaluate(model, data.held_out["val"], display, "val", timed=tested)
        # One value a run: at step 0 MLflow draws bars that compare runs, at any other a line of one point.
        logger.log_metrics(tested.keyed("test/") | validated.keyed("validation/"), 0)
        with tempfile.TemporaryDirectory() as folder:
            loop.save_checkpoint(Path(folder, MODEL_FILE), weights_only=True)
            model.cpu()  # as what was sampled
            if draw is not None:
                draw(model, data, validated, Path(folder, "figures"))
            logger.log_files(folder)
    title = f"{config.name}, preset {config.preset}, {SPLITS[split]} split"
    console.print(summary.results_table((validated if split == "val" else tested).results, title))
    return run_id


def understood(data: DemonstrationData) -> str:
    """What is learned from, in a line or two: a forgotten radius and swapped axes are seen by it."""
    task, (N, T, _) = data.task, data.x.shape
    robots = f"{task.robots.count} robot{'s' if task.robots.count > 1 else ''}"
    kept = ", ".join(
        f"{int(one.violation(data.x).sum()) / N:.1%} violate {name}" for name, one in task.constraints().items()
    )
    text = f"{N} trajectories x {T} waypoints x {robots}: {kept}"
    disagree = int((data.violates != labels(data.config, task).violation(data.x)).sum())
    if task.robots.D > T:
        text += f"\nThere are more numbers in a configuration, {task.robots.D}, than waypoints: are both exchanged?"
    return f"{text}\n{disagree} of the given labels disagree with the constraint" if disagree else text


def experiment(config: Config, data: DemonstrationData) -> recording.Experiment:
    """What a run of these settings on these demonstrations is recorded as."""
    tags = {
        "task": config.task_name,
        "ablation": config.ablation,
        "preset": config.preset,
        "seed": str(config.seed),
        "config_sha": config.sha(),
        "data_digest": data.digest,
        "data_violating_share": f"{data.violates.float().mean():.4f}",
        **{f"data_{split}": str(len(getattr(data, split).x)) for split in ("train", "val", "test")},
    }
    params = {key: str(value) for key, value in flatten(config.identity()).items()}
    x, violates = data.x.numpy(), data.violates.numpy()
    return recording.Experiment(config.name, tags, params, config.tree(), data.origin, x, violates)


def _continued(run: Run, asked: recording.Experiment, config: Config, console: Console, any_code: bool) -> Path | None:
    """The checkpoint from which a run goes on, or None from its beginning."""
    resume.check(run, asked, any_code)
    carried.fetch(run)
    path, step, refused = checkpoints.newest(store.checkpoints(str(run.info.run_id)))
    for reason in refused:
        console.print(f"{reason}; going on from the one before it", highlight=False, soft_wrap=True)
    console.print(
        f"Going on with run {run.info.run_name} from step {step} of {config.train.max_steps}", highlight=False
    )
    return path


def _last_good(run_id: str) -> str:
    path, step, _ = checkpoints.newest(store.checkpoints(run_id))
    if path is None:
        return "there is no checkpoint from before"
    return f"the last good checkpoint is {path}, of step {step}"


def _quiet() -> None:
    """Silence what libraries say that no user of ours can act on."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    for message in (".*does not have many workers.*", ".*LeafSpec.*", ".*smaller than the logging interval.*"):
        warnings.filterwarnings("ignore", message)


def trainer(config: Config, logger: recording.RunLogger, data: DemonstrationData, display: ProgressDisplay) -> Trainer:
    """The training loop of an experiment."""
    _quiet()
    interval = min(config.train.val_every, config.train.max_steps)
    return Trainer(
        accelerator=config.train.accelerator,
        devices=1,
        logger=logger,
        callbacks=[
            Forecast(display.console),
            TrainingLog(config.train.log_every),
            TrainingProgress(display),
            ValidationSamples(data),
            Checkpoints(store.checkpoints(str(logger.run_id)), interval),
        ],
        plugins=[AtomicCheckpointIO()],
        max_steps=config.train.max_steps,
        val_check_interval=interval,
        num_sanity_val_steps=0,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
