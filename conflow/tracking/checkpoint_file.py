"""A checkpoint on disk: written whole or not at all, read without running code. Needs torch alone."""

import contextlib
import os
import uuid
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from conflow.errors import ConfigError


class CheckpointError(ConfigError):
    """A checkpoint that cannot be written or read: which, why, and what there is instead, in one line."""


def write(path: Path, content: bytes | memoryview, previous: Path | None = None) -> None:
    """Replace a file's content at once, so that no interruption leaves half of it.

    Args:
        path: the file.
        content: all of it.
        previous: the name that the file gets that was there.

    Raises:
        CheckpointError: it could not be written; what was there is untouched.
    """
    # Of its own, so that of two processes that write the same file neither gets half of the other's.
    temporary = path.with_name(f"{path.stem}.{uuid.uuid4().hex}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if previous is not None and path.exists():
            with contextlib.suppress(FileNotFoundError):  # the other was faster
                path.replace(previous)
        temporary.replace(path)
        _sync(path.parent)
    except OSError as error:
        kept = f"kept the one before it, {path}" if path.exists() else "there is none before it"
        raise CheckpointError(f"{path}: expected to write a checkpoint, found {error.strerror}; {kept}") from None
    finally:
        temporary.unlink(missing_ok=True)


def load(path: Path) -> dict[str, Any]:
    """The checkpoint in a file. Reads weights and plain values; code in the file is not run.

    Raises:
        FileNotFoundError: there is no such file.
        CheckpointError: it is truncated, damaged, or none of ours.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
        checkpoint = None if damaged else torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception:  # a foreign or damaged file fails in any of a dozen ways, from EOFError to KeyError
        checkpoint = None
    if not isinstance(checkpoint, Mapping) or "conflow" not in checkpoint:
        raise CheckpointError(f"{path}: expected a checkpoint of ConFlow, found a damaged or foreign file")
    return dict(checkpoint)


def _sync(folder: Path) -> None:
    """Make renames in a folder survive a power loss."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
