"""The settings of this room: what is kept, what is in the way, and what is learned from. Without torch, to be quick.

A range beside a type is what the setting may be: from `low` to `high`, or `above`.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

BarrierShape = Literal["softplus", "relu", "square"]
Reduction = Literal["sum", "mean", "closest"]
Pairs = Literal["nearest", "all"]


@dataclass(frozen=True)
class Data:
    """Demonstrations: where they are from, and how they are divided."""

    path: str | None
    num: Annotated[int, {"low": 10, "high": 10**8}]
    horizon: Annotated[int, {"low": 3, "high": 4096}]
    amplitudes: Annotated[list[float], {"low": 0, "high": 1}]
    jitter: Annotated[float, {"low": 0, "high": 0.2}]
    seed: Annotated[int, {"low": 0, "high": 2**32 - 1}]
    negatives: bool
    negative_share: Annotated[float | None, {"low": 0, "high": 1}]
    repair: bool
    unrepaired: Annotated[float, {"low": 0, "high": 1}]
    val_fraction: Annotated[float, {"above": 0, "high": 1}]
    test_fraction: Annotated[float, {"above": 0, "high": 1}]


@dataclass(frozen=True)
class Constraint:
    """The barrier of all constraints, and the distance that robots of the swap keep."""

    radius: Annotated[float, {"above": 0, "high": 2}]
    barrier: BarrierShape
    gamma: Annotated[float, {"low": 1e-6, "high": 1e6}]
    reduction: Reduction
    pairs: Pairs


@dataclass(frozen=True)
class Obstacle:
    """A disc that the robots must not touch: centre (x, y) and radius, in workspace units."""

    x: Annotated[float, {"low": -2, "high": 2}] = 0.0
    y: Annotated[float, {"low": -2, "high": 2}] = 0.5
    radius: Annotated[float, {"above": 0, "high": 2}] = 0.1


@dataclass(frozen=True)
class Ball(Obstacle):
    """A sphere in space: an obstacle at height z."""

    z: float = 0.0


@dataclass(frozen=True)
class Box:
    """A rectangle whose corners are rounded: centre (x, y), full size, and the radius of the corners."""

    x: float
    y: float
    width: float
    height: float
    rounding: float = 0.0
