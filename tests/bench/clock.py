"""Timing things beside each other: in turns, round after round, with medians and quartiles."""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

Block = Callable[[int], float]
"""Does something so many times; the seconds that took."""

Kind = Literal["time", "speed", "share", "seconds"]
"""What a ratio is: our time over another's, another's time over ours, the same as `time` but a part of the whole, or
our seconds alone."""


@dataclass(frozen=True)
class Target:
    """A ratio to reach: at most or at least so much."""

    bound: float
    at_most: bool = True

    def met(self, ratio: float) -> bool:
        return ratio <= self.bound if self.at_most else ratio >= self.bound


@dataclass(frozen=True)
class Row:
    """One line of the bench.

    Attributes:
        part: the section it belongs to.
        what: what was timed.
        beside: what it was timed beside; empty where by itself.
        ours, theirs: seconds per call, median over the rounds; None where a peer is absent.
        kind: what the ratio is.
        ratio, low, high: median and quartiles over the rounds, each with both in it.
        target: what is asked for, if anything.
        note: a word more.
    """

    part: str
    what: str
    beside: str
    ours: float | None
    theirs: float | None
    kind: Kind
    ratio: float | None
    low: float | None
    high: float | None
    target: Target | None = None
    note: str = ""


@dataclass(frozen=True)
class Pace:
    """How long to measure.

    Attributes:
        rounds: turns that each block has.
        at_least: seconds that a turn takes; a block repeats its call as often as that needs.
    """

    rounds: int = 9
    at_least: float = 0.2


def block(call: Callable[[], object]) -> Block:
    """Repeat a call; on an accelerator the time ends when its work has."""

    def run(times: int) -> float:
        _wait()
        start = time.perf_counter()
        for _ in range(times):
            call()
        _wait()
        return time.perf_counter() - start

    return run


def alternate(blocks: Mapping[str, Block], pace: Pace) -> dict[str, list[float]]:
    """Seconds per call of each block, one number a round.

    In each round every block has its turn, another one first each time: whatever slows this machine for a while slows
    all of them, and a ratio within a round is free of it.
    """
    names, times = list(blocks), {}
    for name, run in blocks.items():
        run(1)  # what is made at first use
        times[name] = max(1, round(pace.at_least / max(run(1), 1e-9)))
    seconds: dict[str, list[float]] = {name: [] for name in names}
    for turn in range(pace.rounds):
        for i in range(len(names)):
            name = names[(turn + i) % len(names)]
            seconds[name].append(blocks[name](times[name]) / times[name])
    return seconds


def beside(
    part: str,
    what: str,
    ours: Block,
    others: Mapping[str, Block | None],
    pace: Pace,
    kind: Kind = "speed",
    targets: Mapping[str, Target] | None = None,
    note: str = "",
) -> list[Row]:
    """Lines of one thing beside others, all timed in the same rounds; None stands for a peer that is absent."""
    seconds = alternate({"": ours} | {name: other for name, other in others.items() if other}, pace)
    return [
        compared(part, what, name, seconds[""], seconds[name], kind, (targets or {}).get(name), note)
        if other
        else Row(part, what, name, None, None, kind, None, None, None, note="not installed")
        for name, other in others.items()
    ]


def compared(
    part: str,
    what: str,
    name: str,
    ours: list[float],
    theirs: list[float],
    kind: Kind = "speed",
    target: Target | None = None,
    note: str = "",
) -> Row:
    """The line of what was timed in the same rounds as another."""
    ratios = [b / a if kind == "speed" else a / b for a, b in zip(ours, theirs, strict=True)]
    low, middle, high = quartiles(ratios)
    medians = statistics.median(ours), statistics.median(theirs)
    return Row(part, what, name, *medians, kind, middle, low, high, target, note)


def alone(part: str, what: str, ours: list[float], target: Target | None = None, note: str = "") -> Row:
    """The line of what has nothing beside it: its seconds are the ratio. None of them: it did not come to an end."""
    if not ours:
        return Row(part, what, "", None, None, "seconds", None, None, None, target, note)
    low, middle, high = quartiles(ours)
    return Row(part, what, "", middle, None, "seconds", middle, low, high, target, note)


def quartiles(values: list[float]) -> tuple[float, float, float]:
    """The first quartile, the median and the third."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
    return low, middle, high


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
