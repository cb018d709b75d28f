"""How time and memory grow with the batch, the waypoints, the width of the network, and the number of samples."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from torch.profiler import ProfilerActivity, profile

from conflow.training import config
from tests.bench.clock import Pace, alternate, block, quartiles
from tests.bench.training import RawLoop

MIB = 2**20
GROWTH: dict[str, tuple[str, Sequence[int]]] = {
    "batch": ("train.batch_size", (256, 512, 1024, 2048, 4096)),
    "waypoints": ("data.horizon", (16, 32, 64, 128, 256)),
    "hidden": ("network.hidden", (128, 256, 512, 1024)),
}
"""The settings that a training step is scaled by, from those of `quick`."""
SAMPLES = (256, 512, 1024, 2048, 4096)
EULER_STEPS = 50


@dataclass(frozen=True)
class Point:
    """One size.

    Attributes:
        axis: what was scaled.
        size: to how much.
        seconds: of a training step, or of sampling so many trajectories with 50 Euler steps.
        mib: the most memory that its tensors took at once, beyond the network's weights and the demonstrations.
    """

    axis: str
    size: int
    seconds: float
    mib: float


def points(pace: Pace) -> list[Point]:
    """All sizes of all axes."""
    found = []
    for axis, (setting, sizes) in GROWTH.items():
        loops = {size: RawLoop(config.load(["preset=quick", "data.num=2000", f"{setting}={size}"])) for size in sizes}
        found += _points(axis, {size: loop.step for size, loop in loops.items()}, pace)
    model = RawLoop(config.load(["preset=quick", f"sample.steps={EULER_STEPS}"])).model.eval()
    y = torch.zeros(max(SAMPLES), 2, model.D)

    def sampling(num: int) -> Callable[[], object]:
        return lambda: model.flow(model.source.sample(y[:num]))

    return found + _points("samples", {num: sampling(num) for num in SAMPLES}, pace)


def _points(axis: str, calls: dict[int, Callable[[], object]], pace: Pace) -> list[Point]:
    seconds = alternate({str(size): block(call) for size, call in calls.items()}, pace)
    return [Point(axis, size, quartiles(seconds[str(size)])[1], peak(call) / MIB) for size, call in calls.items()]


def peak(call: Callable[[], object]) -> int:
    """The most bytes that a call's tensors take at once, to one operation."""
    with _hushed(), profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        call()
    taken, most = 0, 0
    for event in sorted(profiler.events(), key=lambda event: event.time_range.start):
        taken += event.self_cpu_memory_usage
        most = max(most, taken)
    return most


@contextmanager
def _hushed() -> Iterator[None]:
    """Keep the profiler's own lines, which it writes past Python, off the terminal."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def figure(found: Sequence[Point]) -> Figure:
    """Time and memory against each axis."""
    axes = list(dict.fromkeys(point.axis for point in found))
    drawn = Figure(figsize=(11, 4.4), layout="constrained")
    panels = drawn.subplots(2, len(axes), sharey="row", sharex="col")
    for (above, below), axis in zip(panels.T, axes, strict=True):
        own = [point for point in found if point.axis == axis]
        sizes = [point.size for point in own]
        above.plot(sizes, [1000 * point.seconds for point in own], color="#0072B2", marker="o", ms=4)
        below.plot(sizes, [point.mib for point in own], color="#D55E00", marker="o", ms=4)
        for panel in (above, below):
            panel.set(xscale="log", yscale="log")
            panel.set_xticks(sizes, [str(size) for size in sizes])
            panel.set_xticks([], minor=True)
            panel.yaxis.set_minor_formatter(NullFormatter())
            panel.spines[["top", "right"]].set_visible(False)
        below.set_xlabel(axis)
        above.set_title("sampling, 50 Euler steps" if axis == "samples" else "a training step", fontsize="medium")
    panels[0, 0].set_ylabel("milliseconds")
    panels[1, 0].set_ylabel("peak memory (MiB)")
    drawn.suptitle("How time and memory grow, from the sizes of preset quick")
    return drawn
