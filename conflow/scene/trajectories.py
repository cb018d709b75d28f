"""Demonstrations of the two-robot swap: generator, files, and what makes them valid (paper: "Task Description")."""

import hashlib
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from conflow.scene.social_force import Robots, walk

# The two robots' nominal starts; each one's goal is the other's start.
SIDES = ((-0.8, 0.0), (0.8, 0.0))

# Amplitudes of the speed's harmonics in `passing`: a robot's speed stays between 0.2 and 1.8 of its mean.
WARP = (0.3, 0.4, 0.1)

# What `passing` and `social` keep away from the radius, so that rounding to float32 changes no label.
MARGIN = 1e-3


class DemonstrationError(ValueError):
    """Demonstrations that cannot be used, with the reason in one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(" ".join(reason.split()))


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
    a = _uniform(generator, num, 2, len(amplitudes)) * torch.tensor(amplitudes)
    p, q = _ends(num, jitter, generator)
    s = torch.linspace(0, 1, T, dtype=torch.float64).float()
    return _trajectories(p, q, s, a @ _harmonics(len(amplitudes), T).float())


def passing(num: int, T: int = 32, seed: int = 0, radius: float = 0.3) -> Tensor:
    """Two robots that swap sides at varying speed and bulge where they pass, x (num, T, 4) as (x1, y1, x2, y2).

    A robot goes along its straight line, as in `swap`, with s a smooth monotone function of time, another one for each
    robot. Orthogonal to travel it deviates by +-h b (1 + cos(pi (s - c) / w)) / 2 where |s - c| < w, else by 0: c is
    where the straight lines come closest, w is uniform in [0.25, 0.35], and the robots' shares b, uniform in
    [0.3, 0.7], add up to 1. Of the trajectories 65 % pass on the right, the others on the left.

    h gives the smallest distance over waypoints its distribution: for 60 % uniform in [radius, 1.2 radius], for 40 %,
    which collide, uniform between that of the straight lines and `radius`. All keep MARGIN from `radius`.

    Raises:
        DemonstrationError: straight lines do not collide, since `radius` or T is too small.
    """
    generator = torch.Generator().manual_seed(seed)
    p, q = (end.double() for end in _ends(num, 0.04, generator))
    s = _warped(num, T, generator)
    straight = _trajectories(p, q, s, torch.zeros_like(s))
    closest = _distances(straight).min(dim=1)
    c = s.take_along_dim(closest.indices[:, None, None], dim=2)
    w = 0.3 + 0.05 * _uniform(generator, num, 2, 1).double()
    share = 0.5 + 0.2 * _uniform(generator, num, 1, 1).double() * torch.tensor([[1.0], [-1.0]])
    side = torch.where(_some(0.65, num, generator), -1.0, 1.0)[:, None, None]
    # NumPy's cos and sin, here and below: of two threads that share torch's one may be less accurate.
    bump = side * share * (1 + torch.from_numpy(np.cos((torch.pi * ((s - c) / w).clamp(-1, 1)).numpy()))) / 2
    bend = _trajectories(p, q, s, bump) - straight

    def bent(h: Tensor) -> Tensor:
        return straight + h[:, None, None] * bend

    wanted = _wanted(closest.values, radius, generator)
    return bent(_bisection(lambda h: _distances(bent(h)).amin(dim=1), wanted, 3 * radius)).float()


def social(num: int, T: int = 32, seed: int = 0, radius: float = 0.3) -> Tensor:
    """Two robots that swap sides and evade each other by the social-force model, x (num, T, 4) as (x1, y1, x2, y2).

    See `social_force.walk`. Each robot has habits of its own, from indifferent to polite. Both sidestep to the right
    in 65 % of the trajectories and to the left in the others, but in 10 % one of them misunderstands. With the default
    radius about 38 % collide at a waypoint. Drawn again is what comes within MARGIN of `radius`, leaves the workspace
    or does not arrive. The first n of a seed are the same for every num >= n.
    """
    generator = torch.Generator().manual_seed(seed)
    x = torch.empty(0, T, 4)
    while len(x) < num:
        drawn, _ = walk(_habits(1000, generator), T, radius)
        inside = (drawn.abs() <= 1).flatten(1).all(dim=1)  # which NaN is not
        clear = (_distances(drawn).amin(dim=1) - radius).abs() > MARGIN
        x = torch.cat([x, drawn[inside & clear].float()])
    return x[:num]


KINDS: dict[str, Callable[..., Tensor]] = {"passing": passing, "social": social}
"""Demonstrations of another kind than `swap`, to be written to a file: generators that take num and seed."""


def _habits(num: int, generator: torch.Generator) -> Robots:
    """Pairs of the robots of `social`."""

    def between(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(num, 2, generator=generator, dtype=torch.float64)

    start, goal = (end.double() for end in _ends(num, 0.04, generator))
    side = torch.where(_some(0.65, num, generator), -1.0, 1.0)
    understood = torch.where(_some(0.9, num, generator), 1.0, -1.0)
    return Robots(
        start,
        goal,
        speed=between(0.45, 1.1),
        drift=between(-0.1, 0.1),
        repulsion=between(0, 10),
        reach=between(0.05, 0.1),
        sidestep=between(1, 5) * torch.stack([side, side * understood], dim=1),
        sight=between(0.3, 0.5),
    )


def _uniform(generator: torch.Generator, *shape: int) -> Tensor:
    return 2 * torch.rand(*shape, generator=generator) - 1


def _some(share: float, num: int, generator: torch.Generator) -> Tensor:
    """A share of `num`, to the nearest whole number, drawn by chance: boolean (num,)."""
    return torch.randperm(num, generator=generator) < round(share * num)


def _ends(num: int, jitter: float, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Starts p and goals q of both robots, (num, 2, 2) each."""
    sides = torch.tensor(SIDES)
    p = sides + jitter * _uniform(generator, num, 2, 2)
    return p, sides.flip(0) + jitter * _uniform(generator, num, 2, 2)


def _harmonics(count: int, T: int) -> Tensor:
    """sin(k pi s) for k = 1, ..., count, (count, T), zero at both ends."""
    s = torch.linspace(0, 1, T, dtype=torch.float64)
    harmonics = torch.from_numpy(np.sin((torch.pi * torch.arange(1, count + 1)[:, None] * s).numpy()))
    harmonics[:, -1] = 0  # sin(k pi) in floating point is not
    return harmonics


def _warped(num: int, T: int, generator: torch.Generator) -> Tensor:
    """s(t) = t + sum_k a_k sin(k pi t) / (k pi) of both robots, (num, 2, T), with a_k uniform in +-WARP[k-1]."""
    a = _uniform(generator, num, 2, len(WARP)).double() * torch.tensor(WARP)
    rate = torch.pi * torch.arange(1, len(WARP) + 1)
    return torch.linspace(0, 1, T, dtype=torch.float64) + (a / rate) @ _harmonics(len(WARP), T)


def _trajectories(p: Tensor, q: Tensor, s: Tensor, deviation: Tensor) -> Tensor:
    """p + s (q - p) + deviation n, (num, T, 4), with n the unit normal to the left of travel; s (T,) or (num, 2, T)."""
    travel = q - p
    n = torch.stack([-travel[..., 1], travel[..., 0]], dim=-1) / torch.linalg.vector_norm(travel, dim=-1, keepdim=True)
    line = torch.lerp(p[:, :, None], q[:, :, None], s[..., None])
    return (line + deviation[..., None] * n[:, :, None]).transpose(1, 2).flatten(2)


def _distances(x: Tensor) -> Tensor:
    """The distance of two robots at every waypoint of x (num, T, 4), (num, T)."""
    return torch.linalg.vector_norm(x[..., :2] - x[..., 2:], dim=2)


def _wanted(straight: Tensor, radius: float, generator: torch.Generator) -> Tensor:
    """The smallest distances that `passing` promises, (num,), for those of the straight lines, which are below."""
    inside, outside = radius - MARGIN, radius + MARGIN
    if bool((straight >= inside).any()):
        raise DemonstrationError(
            f"radius={radius}: straight lines keep a distance of up to {float(straight.max()):.3f} at waypoints, "
            f"expected less than {inside:.3f}"
        )
    share = torch.rand(len(straight), generator=generator).double()
    collides = _some(0.4, len(straight), generator)
    return torch.where(collides, straight + share * (inside - straight), outside + share * (1.2 * radius - outside))


def _bisection(f: Callable[[Tensor], Tensor], wanted: Tensor, high: float) -> Tensor:
    """h (num,) with f(h) = wanted to rounding, for a continuous f with f(0) <= wanted <= f(high)."""
    low, up = torch.zeros_like(wanted), torch.full_like(wanted, high)
    for _ in range(40):
        middle = (low + up) / 2
        below = f(middle) < wanted
        low, up = torch.where(below, middle, low), torch.where(below, up, middle)
    return up


def load(path: str | Path) -> Demonstrations:
    """Demonstrations from an .npz file: `x` (N, T, D) and optionally `violates`, boolean (N,).

    Raises:
        DemonstrationError: the file is missing or unreadable, or its arrays are not of that kind.
    """
    try:
        if not Path(path).is_file():  # of a pipe, reading would never end
            raise FileNotFoundError
        with np.load(path, allow_pickle=False) as file:
            # What of a foreign archive is no array comes as bytes.
            arrays = {name: np.asarray(file[name]) for name in ("x", "violates") if name in file}
    except FileNotFoundError:
        raise DemonstrationError(f"data.path={path}: no such file, expected an .npz file with numeric arrays") from None
    except MemoryError as error:
        raise DemonstrationError(f"data.path={path}: {error}, expected arrays that fit into memory") from None
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
    with np.errstate(over="ignore"):  # `check` refuses what becomes infinite
        x = x.astype(np.float32)
    return Demonstrations(torch.from_numpy(x), None if violates is None else torch.from_numpy(violates))


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
            f"{int((~finite).nonzero()[0])}, expected finite numbers in the workspace [-1, 1]"
        )
    outside = x.abs().flatten(1).amax(dim=1) > 1
    if bool(outside.any()):
        raise DemonstrationError(
            f"{name}: {int(outside.sum())} trajectories leave the workspace [-1, 1], the first is "
            f"{int(outside.nonzero()[0])}, expected all of them inside"
        )


def save(path: str | Path, x: Tensor) -> None:
    """Write trajectories x (N, T, D) as a new .npz file that `load` reads, whole or not at all.

    Raises:
        DemonstrationError: the name does not end in .npz, there is such a file, or it cannot be written.
    """
    if Path(path).suffix != ".npz":
        raise DemonstrationError(f"out={path}: expected a name that ends in .npz")
    path = Path(path)
    try:
        with tempfile.TemporaryDirectory(prefix=".conflow-", dir=path.parent) as folder:
            part = Path(folder, path.name)
            np.savez(part, x=x.numpy())
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
