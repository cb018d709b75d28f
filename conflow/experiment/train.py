"""One experiment from its config to a finished MLflow run."""

import logging
import tempfile
import warnings
from pathlib import Path

import lightning
from lightning import Trainer
from mlflow.entities import Run
from rich.console import Console

from conflow.experiment import checkpoints, figures, report, resume, tracking
from conflow.experiment.build import fitted
from conflow.experiment.callbacks import TrainingLog, TrainingProgress, ValidationSamples
from conflow.experiment.checkpoints import AtomicCheckpointIO, Checkpoints
from conflow.experiment.config import SPLITS, Config, SplitName
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.evaluation import evaluate
from conflow.experiment.finished import MODEL_FILE
from conflow.experiment.module import ConFlow, DivergedError
from conflow.experiment.progress import ProgressDisplay


def train(config: Config, console: Console, wanted: str = "", any_code: bool = False, split: SplitName = "val") -> str:
    """Train, sample, evaluate and log one experiment; the id of its run.

    Both splits that are held out are measured and logged: methods are chosen by the one and reported by the other.

    Args:
        config: the experiment.
        console: for progress and results.
        wanted: an interrupted run of this experiment to go on with: its id, NAME, PRESET/NAME, or "latest".
        any_code: go on with it also where other code began it.
        split: the one whose results are printed.

    Raises:
        DemonstrationError: before anything is tracked.
        ConfigError: there is no such run, or it is of another experiment or of other code.
        CheckpointError: a checkpoint could not be written.
        DivergedError: a loss or gradient was not finite.
    """
    lightning.seed_everything(config.seed, verbose=False)
    data = DemonstrationData(config)
    model = ConFlow(fitted(config, data.train.feasible().x), data.T, data.D)
    model.fit(data.train.feasible().x)
    interrupted = resume.find(wanted) if wanted else None
    checkpoint = _continued(interrupted, config, data, console, any_code) if interrupted else None
    with tracking.start(config, data, interrupted) as logger:
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
            pictures = {
                "page": figures.page(model, data, validated, "val"),
                "demonstrations": figures.demonstrations(data),
                "sources": figures.sources(model, validated),
            }
            figures.save(pictures, Path(folder, "figures"))
            logger.log_files(folder)
    title = f"{config.ablation}-s{config.seed}, preset {config.preset}, {SPLITS[split]} split"
    console.print(report.results_table((validated if split == "val" else tested).results, title))
    return run_id


def _continued(run: Run, config: Config, data: DemonstrationData, console: Console, any_code: bool) -> Path | None:
    """The checkpoint from which a run goes on, or None from its beginning."""
    resume.check(run, config, data, any_code)
    path, step, refused = checkpoints.newest(tracking.checkpoints(str(run.info.run_id)))
    for reason in refused:
        console.print(f"{reason}; going on from the one before it", highlight=False, soft_wrap=True)
    console.print(
        f"Going on with run {run.info.run_name} from step {step} of {config.train.max_steps}", highlight=False
    )
    return path


def _last_good(run_id: str) -> str:
    path, step, _ = checkpoints.newest(tracking.checkpoints(run_id))
    if path is None:
        return "there is no checkpoint from before"
    return f"the last good checkpoint is {path}, of step {step}"


def _quiet() -> None:
    """Silence what libraries say that no user of ours can act on."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    for message in (".*does not have many workers.*", ".*LeafSpec.*", ".*smaller than the logging interval.*"):
        warnings.filterwarnings("ignore", message)


def trainer(config: Config, logger: tracking.RunLogger, data: DemonstrationData, display: ProgressDisplay) -> Trainer:
    """The training loop of an experiment."""
    _quiet()
    interval = min(config.train.val_every, config.train.max_steps)
    return Trainer(
        accelerator=config.train.accelerator,
        devices=1,
        logger=logger,
        callbacks=[
            TrainingLog(config.train.log_every),
            TrainingProgress(display),
            ValidationSamples(data),
            Checkpoints(tracking.checkpoints(str(logger.run_id)), interval),
        ],
        plugins=[AtomicCheckpointIO()],
        max_steps=config.train.max_steps,
        val_check_interval=interval,
        num_sanity_val_steps=0,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
