"""Demonstrations of the two-robot swap: generator, files, and what makes them valid (paper: "Task Description")."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

# The two robots' nominal starts; each one's goal is the other's start.
SIDES = ((-0.8, 0.0), (0.8, 0.0))


class DemonstrationError(ValueError):
    """Demonstrations that cannot be used, with the reason in one line."""


class Demonstrations(NamedTuple):
    """Trajectories x (N, T, D) and, where their author labelled them, the violations M (N,)."""

    x: Tensor
    violates: Tensor | None


def swap(
    num: int, T: int = 32, amplitudes: Sequence[float] = (0.93, 0.11), jitter: float = 0.04, seed: int = 0
) -> Tensor:
    """Two robots that swap sides, x (num, T, 4) as (x1, y1, x2, y2).

    Each robot goes along its straight line from p to q with a deviation orthogonal to travel,
    x(s) = p + s (q - p) + n sum_k a_k sin(k pi s), a_k uniform in +-amplitudes[k-1]. The coordinates of p and q
    are jittered uniformly by +-jitter. Of the defaults' trajectories 30 % come closer than 0.3.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    s = torch.linspace(0, 1, T, dtype=torch.float64)
    k = torch.arange(1, len(amplitudes) + 1)
    harmonics = torch.sin(torch.pi * k[:, None] * s)
    harmonics[:, -1] = 0  # sin(k pi) in floating point is not
    a = uniform(num, 2, len(amplitudes)) * torch.tensor(amplitudes)
    sides = torch.tensor(SIDES)
    p = sides + jitter * uniform(num, 2, 2)
    q = sides.flip(0) + jitter * uniform(num, 2, 2)
    travel = q - p
    n = torch.stack([-travel[..., 1], travel[..., 0]], dim=-1) / torch.linalg.vector_norm(travel, dim=-1, keepdim=True)
    deviation = (a @ harmonics.float())[..., None]
    line = torch.lerp(p[:, :, None], q[:, :, None], s.float()[:, None])
    return (line + deviation * n[:, :, None]).transpose(1, 2).flatten(2)


def load(path: str | Path) -> Demonstrations:
    """Demonstrations from an .npz file: `x` (N, T, D) and optionally `violates`, boolean (N,).

    Raises:
        DemonstrationError: the file is missing or unreadable, or its arrays are not of that kind.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in ("x", "violates") if name in file}
    except FileNotFoundError:
        raise DemonstrationError(f"data.path={path}: no such file") from None
    except Exception:  # a damaged file fails in any of a dozen ways, from zlib.error to TokenError
        raise DemonstrationError(f"data.path={path}: expected an .npz file with numeric arrays") from None
    if "x" not in arrays:
        raise DemonstrationError(f"data.path={path}: expected an array named x of shape (N, T, D)")
    x, violates = arrays["x"], arrays.get("violates")
    if not np.issubdtype(x.dtype, np.floating):
        raise DemonstrationError(f"data.path={path}: x holds {x.dtype}, expected floating-point numbers")
    if violates is not None and (violates.dtype != np.bool_ or violates.shape != x.shape[:1]):
        raise DemonstrationError(
            f"data.path={path}: violates holds {violates.dtype} of shape {violates.shape}, "
            f"expected bool of shape {x.shape[:1]}"
        )
    return Demonstrations(
        torch.from_numpy(x.astype(np.float32)), None if violates is None else torch.from_numpy(violates)
    )


def check(x: Tensor, name: str) -> None:
    """Refuse trajectories x that are not (N, T, D) of planar robots, finite and inside the workspace [-1, 1]^2.

    Raises:
        DemonstrationError: names `name`, what was found and what was expected.
    """
    if x.ndim != 3 or x.shape[1] < 3 or x.shape[2] < 4 or x.shape[2] % 2:
        raise DemonstrationError(
            f"{name}: x has shape {tuple(x.shape)}, expected (N, T, D) with T >= 3 waypoints and D = 2 per robot, "
            "two robots or more"
        )
    if not len(x):
        raise DemonstrationError(f"{name}: x is empty, expected at least one trajectory")
    finite = torch.isfinite(x).flatten(1).all(dim=1)
    if not bool(finite.all()):
        raise DemonstrationError(
            f"{name}: {int((~finite).sum())} trajectories hold NaN or infinity, the first is "
            f"{int((~finite).nonzero()[0])}"
        )
    outside = x.abs().flatten(1).amax(dim=1) > 1
    if bool(outside.any()):
        raise DemonstrationError(
            f"{name}: {int(outside.sum())} trajectories leave the workspace [-1, 1], the first is "
            f"{int(outside.nonzero()[0])}"
        )


def digest(x: Tensor) -> str:
    """A fingerprint of trajectories: SHA-256 over shape and bytes, 16 hexadecimal digits."""
    content = hashlib.sha256(str(tuple(x.shape)).encode())
    content.update(x.contiguous().numpy().tobytes())
    return content.hexdigest()[:16]
