"""The state of training on disk, and when it is written."""

import io
import time
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, Trainer
from lightning.pytorch.plugins.io import CheckpointIO

from conflow.tracking import ranks
from conflow.tracking.checkpoint_file import CheckpointError, load, write

SECONDS = 60.0
"""The most training that is lost to an interruption, beside the step in progress."""
LAST, PREVIOUS = "last.ckpt", "previous.ckpt"


class AtomicCheckpointIO(CheckpointIO):
    """Checkpoints that are complete whenever they bear their name, and the one before."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Write a sibling, sync it, and rename it; a `last.ckpt` that bore the name becomes `previous.ckpt`.

        Raises:
            CheckpointError: it could not be written; what was there is untouched.
        """
        # In memory first: the disk's errors then come as what they are, not as torch's.
        content = io.BytesIO()
        torch.save(checkpoint, content)
        write(Path(path), content.getbuffer(), Path(path).with_name(PREVIOUS) if Path(path).name == LAST else None)

    def load_checkpoint(
        self, path: str | Path, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """The checkpoint, as `load`, whatever Lightning asks for; of several processes the first one reads it."""
        return ranks.of_first(lambda: load(Path(path)))

    def remove_checkpoint(self, path: str | Path) -> None:
        Path(path).unlink(missing_ok=True)


class Checkpoints(Callback):
    """Saves the state of training into a folder after every validation, at the end, and every minute in between.

    Comes last among the callbacks, so that all others have done their part of the step when it saves.
    """

    def __init__(self, folder: Path, val_every: int) -> None:
        self.path, self.val_every = folder / LAST, val_every
        self.saved = 0.0

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.saved = time.monotonic()

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, batch: Any, batch_idx: int) -> None:
        # Where a validation follows, its results belong into what is saved: Lightning would not run it again.
        # Saving is for all processes at once, so it is the first one's clock that counts.
        if trainer.global_step % self.val_every and ranks.first_says(time.monotonic() - self.saved > SECONDS):
            self._save(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        self._save(trainer)

    def on_train_end(self, trainer: Trainer, pl_module: Any) -> None:
        self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        if trainer.logger is not None:
            trainer.logger.save()  # a step before the checkpoint is not taken again, so its metrics must be safe
        trainer.save_checkpoint(self.path)
        self.saved = time.monotonic()
        if trainer.logger is not None:
            trainer.logger.after_save_checkpoint(self)  # type: ignore[arg-type]  # Lightning's own has a path too


def newest(folder: Path) -> tuple[Path | None, int, list[str]]:
    """The newest complete checkpoint of training in a folder, its step, and what is wrong with newer ones.

    None and step 0 where there is none.
    """
    refused: list[str] = []
    for path in (folder / LAST, folder / PREVIOUS):
        try:
            checkpoint = load(path)
            if "loops" in checkpoint:
                return path, checkpoint["global_step"], refused
            refused.append(f"{path}: expected the state of a training, found a model alone")
        except FileNotFoundError:
            pass
        except CheckpointError as error:
            refused.append(str(error))
    return None, 0, refused
