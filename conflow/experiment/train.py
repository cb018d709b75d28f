"""One experiment from its config to a finished MLflow run."""

import logging
import tempfile
import warnings
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from rich.console import Console

from conflow.experiment import config as configuration
from conflow.experiment import figures, report, tracking
from conflow.experiment.callbacks import Evaluate, ProgressDisplay, TrainingLog, TrainingProgress
from conflow.experiment.config import Config
from conflow.experiment.datamodule import DemonstrationData
from conflow.experiment.module import ConFlow

MODEL_FILE = "model.ckpt"


def train(config: Config, console: Console) -> str:
    """Train, sample, evaluate and log one experiment; the id of its run.

    Raises:
        DemonstrationError: before anything is tracked.
    """
    _quiet()
    lightning.seed_everything(config.seed, verbose=False)
    data = DemonstrationData(config)
    model = ConFlow(config, data.T, data.D, data.train.feasible().x)
    with tracking.start(config, data) as logger:
        run_id = str(logger.run_id)
        display = ProgressDisplay(console)
        evaluate = Evaluate(data, display)
        trainer = _trainer(config, logger, [evaluate, TrainingLog(config.train.log_every), TrainingProgress(display)])
        trainer.fit(model, data)
        title = f"{config.ablation}-s{config.seed}, preset {config.preset}"
        with tempfile.TemporaryDirectory() as folder:
            trainer.save_checkpoint(Path(folder, MODEL_FILE), weights_only=True)
            pictures = {
                "page": figures.page(model, data, evaluate),
                "demonstrations": figures.demonstrations(data),
                "sources": figures.sources(model, evaluate),
            }
            figures.save(pictures, Path(folder, "figures"))
            logger.store.log_artifacts(run_id, folder)
    console.print(report.results_table(evaluate.results, title))
    return run_id


def load_model(path: Path) -> ConFlow:
    """The model that a run left in `model.ckpt`, ready to sample. Reads weights and plain values, runs no code."""
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    described = checkpoint["conflow"]
    model = ConFlow(configuration.from_tree(described["config"]), described["T"], described["D"])
    model.load_state_dict(checkpoint["state_dict"])
    return model.eval()


def _quiet() -> None:
    """Silence what libraries say that no user of ours can act on."""
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    logging.getLogger("mlflow").setLevel(logging.ERROR)
    for message in (".*does not have many workers.*", ".*LeafSpec.*", ".*smaller than the logging interval.*"):
        warnings.filterwarnings("ignore", message)


def _trainer(config: Config, logger: tracking.RunLogger, callbacks: list[Any]) -> Trainer:
    interval = min(config.train.val_every, config.train.max_steps)
    checkpoints = tracking.RUNS / "checkpoints" / str(logger.run_id)
    checkpoint = ModelCheckpoint(
        checkpoints, filename="last", every_n_train_steps=interval, enable_version_counter=False
    )
    return Trainer(
        accelerator="auto",
        devices=1,
        logger=logger,
        callbacks=[*callbacks, checkpoint],
        max_steps=config.train.max_steps,
        val_check_interval=interval,
        num_sanity_val_steps=0,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
