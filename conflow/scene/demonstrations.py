"""Demonstrations: files of them, and what makes them valid."""

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from conflow.scene.errors import DemonstrationError

NUMBERS: dict[str, tuple[int, ...]] = {"scale": (), "offset": (2,), "seconds": ()}
"""What a file may say beside its trajectories, and the shape of it."""


class Demonstrations(NamedTuple):
    """Trajectories and what their author says of them; what is None is left to the task.

    A task may make it of NumPy's arrays; training sees it as `typed` says.

    Attributes:
        x: (N, T, D), in workspace units.
        violates: M, boolean (N,).
        scale, offset: the user's coordinates are `scale` x + `offset`, a number for each of the plane's two axes.
        seconds: how long one takes.
    """

    x: Tensor
    violates: Tensor | None = None
    scale: float | None = None
    offset: Sequence[float] | None = None
    seconds: float | None = None


def load(path: str | Path) -> Demonstrations:
    """Demonstrations from an .npz file: `x` (N, T, D), and optionally `violates`, boolean (N,), and numbers.

    These are `scale`, `offset` (2,) and `seconds`, see `Demonstrations`.

    Raises:
        DemonstrationError: the file is missing or unreadable, or its arrays are not of that kind.
    """
    try:
        if not Path(path).is_file():  # of a pipe, reading would never end
            raise FileNotFoundError
        with np.load(path, allow_pickle=False) as file:
            # What of a foreign archive is no array comes as bytes.
            arrays = {name: np.asarray(file[name]) for name in ("x", "violates", *NUMBERS) if name in file}
    except FileNotFoundError:
        raise DemonstrationError(f"data.path={path}: no such file, expected an .npz file with numeric arrays") from None
    except MemoryError as error:
        raise DemonstrationError(f"data.path={path}: {error}, expected arrays that fit into memory") from None
    except Exception:  # a damaged file fails in any of a dozen ways, from zlib.error to TokenError
        raise DemonstrationError(f"data.path={path}: expected an .npz file with numeric arrays") from None
    if "x" not in arrays:
        raise DemonstrationError(f"data.path={path}: expected an array named x of shape (N, T, D)")
    return _typed(arrays, f"data.path={path}")


def typed(made: Demonstrations, name: str) -> Demonstrations:
    """Demonstrations of a task's own generator as `load` gives those of a file: x in float32, plain numbers.

    Raises:
        DemonstrationError: names `name`; its arrays are not of that kind.
    """
    said = {key: value for key, value in made._asdict().items() if value is not None or key == "x"}
    try:
        arrays = {
            key: np.asarray(value.detach().cpu() if isinstance(value, Tensor) else value) for key, value in said.items()
        }
    except (TypeError, ValueError, RuntimeError) as error:
        raise DemonstrationError(f"{name}: {error}, expected arrays of numbers") from None
    return _typed(arrays, name)


def _typed(arrays: Mapping[str, np.ndarray], name: str) -> Demonstrations:
    """Demonstrations of arrays: x floating-point, `violates` boolean and as many, and numbers."""
    x, violates = arrays["x"], arrays.get("violates")
    if not np.issubdtype(x.dtype, np.floating):
        raise DemonstrationError(f"{name}: x holds {x.dtype}, expected floating-point numbers")
    if violates is not None and (violates.dtype != np.bool_ or violates.shape != x.shape[:1]):
        raise DemonstrationError(
            f"{name}: violates holds {violates.dtype} of shape {violates.shape}, expected bool of shape {x.shape[:1]}"
        )
    # Of a view that is read backwards, or cannot be written, torch takes a copy alone.
    with np.errstate(over="ignore"):  # `check` refuses what becomes infinite
        x = np.require(x, np.float32, ["C", "W"])
    labels = None if violates is None else torch.from_numpy(np.require(violates, np.bool_, ["C", "W"]))
    return Demonstrations(torch.from_numpy(x), labels, **_numbers(name, arrays))


def _numbers(origin: str, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Scale, offset and seconds, where they are said."""
    values = {}
    for name, shape in NUMBERS.items():
        if name not in arrays:
            continue
        array = arrays[name]
        numeric = np.issubdtype(array.dtype, np.floating) or np.issubdtype(array.dtype, np.integer)
        if array.shape != shape or not numeric or not np.isfinite(array).all():
            raise DemonstrationError(f"{origin}: {name} has shape {array.shape}, expected {shape}, finite numbers")
        values[name] = array.astype(np.float64).tolist()
        if name != "offset" and not values[name] > 0:
            raise DemonstrationError(f"{origin}: {name}={values[name]}: expected a number above 0")
    return values


def check(x: Tensor, name: str) -> None:
    """Refuse trajectories x that are not (N, T, D), finite and inside the workspace, [-1, 1] in every number.

    Raises:
        DemonstrationError: names `name`, what was found and what was expected.
    """
    if x.ndim != 3 or x.shape[1] < 3 or x.shape[2] < 1:
        raise DemonstrationError(
            f"{name}: x has shape {tuple(x.shape)}, expected (N, T, D) with T >= 3 waypoints and D numbers each"
        )
    if not len(x):
        raise DemonstrationError(f"{name}: x is empty, expected at least one trajectory")
    finite = torch.isfinite(x).flatten(1).all(dim=1)
    if not bool(finite.all()):
        raise DemonstrationError(
            f"{name}: {int((~finite).sum())} trajectories hold NaN or infinity, the first is "
            f"{int((~finite).nonzero()[0])}, expected finite numbers in the workspace [-1, 1]"
        )
    outside = x.abs().flatten(1).amax(dim=1) > 1
    if bool(outside.any()):
        found = f"found {float(x.min()):.4g} to {float(x.max()):.4g}, expected all of them inside"
        raise DemonstrationError(
            f"{name}: {int(outside.sum())} trajectories leave the workspace [-1, 1], the first is "
            f"{int(outside.nonzero()[0])}, {found}"
        )


def save(path: str | Path, made: Demonstrations) -> None:
    """Write demonstrations as a new .npz file that `load` reads, whole or not at all.

    Raises:
        DemonstrationError: the name does not end in .npz, there is such a file, or it cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise DemonstrationError(f"out={path}: expected a name that ends in .npz")
    path = Path(path)
    try:
        with tempfile.TemporaryDirectory(prefix=".conflow-", dir=path.parent) as folder:
            part = Path(folder, path.name)
            said: dict[str, Any] = {name: value for name, value in made._asdict().items() if value is not None}
            np.savez(part, **said)
            path.hardlink_to(part)  # which, unlike a rename, refuses to replace a file
    except OSError as error:
        raise DemonstrationError(f"out={path}: {error.strerror}, expected a new file in an existing folder") from None


def digest(x: Tensor, violates: Tensor | None = None) -> str:
    """A fingerprint of demonstrations: SHA-256 over shape and bytes, and over their author's labels, 16 hex digits."""
    content = hashlib.sha256(str(tuple(x.shape)).encode())
    content.update(x.contiguous().numpy().tobytes())
    if violates is not None:
        content.update(violates.numpy().tobytes())
    return content.hexdigest()[:16]
