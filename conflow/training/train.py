"""One experiment from its config to a finished MLflow run."""

import logging
import tempfile
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import lightning
from lightning import Trainer
from lightning.fabric.plugins.environments.lightning import LightningEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.pytorch.strategies import DDPStrategy
from mlflow.entities import Run
from rich.console import Console

from conflow.errors import ConfigError
from conflow.scene.task import Task
from conflow.tracking import carried, checkpoints, code, ranks, recording, resume, store
from conflow.tracking.checkpoints import AtomicCheckpointIO, Checkpoints
from conflow.training import summary
from conflow.training.build import fitted, labels
from conflow.training.callbacks import OwnSignals, TrainingLog, TrainingProgress, ValidationSamples
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
    Where several processes train, each does so on its share of every batch, and the first one alone does all else.

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
    first = ranks.rank() == 0
    with ranks.joined(together=DivergedError):
        with ranks.all_or_none():
            data = DemonstrationData(config, task)
            check_shares(config, data)
        asked = experiment(config, data)
        ranks.check_alike(asked.tags, code.files(), recording.versions())
        model = Training(ranks.of_first(lambda: fitted(config, data.known)), data.task)
        model.fit(data.known)
        interrupted = resume.find(wanted, asked.tags["config_sha"]) if wanted and first else None
        checkpoint = _continued(interrupted, asked, config, console, any_code) if interrupted else None
        checkpoint = ranks.of_first(lambda: checkpoint)
        console.print(understood(data), highlight=False, soft_wrap=True)
        record = recording.start(asked, interrupted) if first else nullcontext()
        with record as logger, tempfile.TemporaryDirectory() as folder:
            run_id = ranks.of_first(lambda: str(logger and logger.run_id))
            if config.source.fit and logger:
                kernel = model.config.source
                logger.log_metrics({"source/length_scale": kernel.length_scale, "source/sigma_f": kernel.sigma_f}, 0)
            with ProgressDisplay(console) as display:
                loop = trainer(config, logger, data, display)
                try:
                    loop.fit(model, data, ckpt_path=checkpoint)
                except DivergedError as error:
                    raise DivergedError(f"{error}; {_last_good(run_id)}") from None
                loop.save_checkpoint(Path(folder, MODEL_FILE), weights_only=True)
                ranks.leave()
                if logger is None:
                    return run_id
                # Lightning leaves the model on the CPU.
                model.eval().to(loop.strategy.root_device)
                tested = evaluate(model, data.held_out["test"], display, "test")
                validated = evaluate(model, data.held_out["val"], display, "val", timed=tested)
            # One value a run: at step 0 MLflow draws bars that compare runs, at any other a line of one point.
            logger.log_metrics(tested.keyed("test/") | validated.keyed("validation/"), 0)
            model.cpu()  # as what was sampled
            if draw is not None:
                draw(model, data, validated, Path(folder, "figures"))
            logger.log_files(folder)
    title = f"{config.name}, preset {config.preset}, {SPLITS[split]} split"
    console.print(summary.results_table(validated if split == "val" else tested, title))
    return run_id


def check_shares(config: Config, data: DemonstrationData) -> None:
    """Refuse batches of which the processes that train would not all have as many rows.

    Raises:
        ConfigError: names the setting and how many processes there are.
    """
    for size in data.train_dataloader().sizes:
        if size % ranks.world():
            expected = f"expected batches that divide by {ranks.world()}, the processes that share them"
            raise ConfigError(f"train.batch_size={config.train.batch_size}: found batches of {size}, {expected}")


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
        "devices": str(ranks.world()),
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
    if (before := run.data.tags.get("devices", "1")) != str(ranks.world()):
        exact = "equal to a training on either up to rounding, not to the last bit"
        console.print(f"Begun on {before} devices, going on on {ranks.world()}: {exact}", highlight=False)
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
    messages = (".*does not have many workers.*", ".*LeafSpec.*", ".*smaller than the logging interval.*")
    # Where there is SLURM it says how to be started by that; ranks are started by torchrun.
    for message in (*messages, ".*sync_dist=True.*", ".*broadcast_buffers.*", ".*`srun` command is available.*"):
        warnings.filterwarnings("ignore", message)


def trainer(
    config: Config, logger: recording.RunLogger | None, data: DemonstrationData, display: ProgressDisplay
) -> Trainer:
    """The training loop of an experiment; without a logger that of a process that is not the first one."""
    _quiet()
    interval = min(config.train.val_every, config.train.max_steps)
    folder = store.checkpoints(str(logger.run_id) if logger else "of the first process")
    several = ranks.world() > 1
    return Trainer(
        accelerator=config.train.accelerator,
        devices=ranks.on_node(),
        num_nodes=ranks.world() // ranks.on_node(),
        # Gradients keep their places: rearranged after the first step, as is usual, they would add up in another order
        # where a run goes on. Buffers follow from config and data.
        strategy=DDPStrategy(find_unused_parameters=True, broadcast_buffers=False) if several else "auto",
        logger=logger or False,
        callbacks=[
            *([OwnSignals()] if several else []),
            Forecast(display.console),
            TrainingLog(config.train.log_every),
            TrainingProgress(display),
            ValidationSamples(data),
            Checkpoints(folder, interval),
        ],
        # Said, not found: where SLURM started this process Lightning would do as if each of its tasks were a rank, and
        # go on with what another run left in its root folder.
        plugins=[AtomicCheckpointIO(), TorchElasticEnvironment() if several else LightningEnvironment()],
        default_root_dir=folder,
        use_distributed_sampler=False,  # every process has the whole of what is shared and of what is validated
        max_steps=config.train.max_steps,
        val_check_interval=interval,
        num_sanity_val_steps=0,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
