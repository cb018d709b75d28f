"""Time to quality: seconds of training until few unguided samples collide on validation."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.figure import Figure
from mlflow.entities import Run

from conflow.figures.curves import MARK
from conflow.figures.front import COLOURS, MARKERS
from conflow.results.records import Record, finished
from conflow.results.tables import METHODS
from conflow.tracking import store
from conflow.training import config
from conflow.training.callbacks import VALIDATION_SAMPLES
from tests.bench.clock import Row, alone

RATE = 0.016
"""The paper's unguided rate of ConFlow."""
ALSO = ("train.val_every", "sample.num")
"""What a run may have changed and still be a run of its ablation: how often and how much it was measured."""


@dataclass(frozen=True)
class Curve:
    """A run's validations.

    Attributes:
        seconds: of training, without validations, until each of them.
        counts: unguided samples in collision at each.
        total: samples at each.
        hardware: what it was trained on, with how many threads.
    """

    ablation: str
    seed: int
    steps: list[int]
    seconds: list[float]
    counts: list[int]
    total: int
    hardware: str

    def reached(self) -> float | None:
        """The seconds until the rate is first at most RATE; None where it never is."""
        for seconds, count in zip(self.seconds, self.counts, strict=True):
            if count <= RATE * self.total:
                return seconds
        return None


def curves(preset: str) -> list[Curve]:
    """The first of the finished runs of every ablation and seed at a preset, of those that counted their seconds."""
    newest: dict[tuple[str, int], Curve] = {}
    for run in finished(preset):
        key = run.data.tags["ablation"], int(run.data.tags["seed"])
        if key in newest or key[0] not in config.names("ablation") or "train/seconds" not in run.data.metrics:
            continue
        if all(change.startswith(ALSO) for change in Record.of(run).changes):
            newest[key] = _curve(run)
    rank = {ablation: i for i, ablation in enumerate(METHODS)}
    return sorted(newest.values(), key=lambda one: (rank.get(one.ablation, len(rank)), one.ablation, one.seed))


def _curve(run: Run) -> Curve:
    seconds = _history(run, "train/seconds")
    counts = {step: int(count) for step, count in _history(run, "val/none/robot_collision_count").items()}
    # At the last step training is logged whatever its number; in between where both intervals meet.
    steps = sorted(counts.keys() & seconds.keys())
    total = min(VALIDATION_SAMPLES, int(run.data.params["sample.num"]))
    tags = run.data.tags
    hardware = f"{tags['hardware']}, {tags['threads']} threads"
    at = [seconds[step] for step in steps]
    return Curve(tags["ablation"], int(tags["seed"]), steps, at, [counts[step] for step in steps], total, hardware)


def _history(run: Run, key: str) -> dict[int, float]:
    points = store.client().get_metric_history(run.info.run_id, key)
    return {point.step: point.value for point in points}


def rows(found: Sequence[Curve], preset: str) -> list[Row]:
    """A line for each ablation: the seconds of its seeds."""
    part = f"seconds of training to an unguided rate of at most {RATE} on validation, preset {preset}"
    lines = []
    for ablation in dict.fromkeys(one.ablation for one in found):
        own = [one for one in found if one.ablation == ablation]
        reached = [seconds for one in own if (seconds := one.reached()) is not None]
        last = ", ".join(f"{one.counts[-1]} of {one.total}" for one in own)
        note = f"{len(reached)} of {len(own)} seeds; {last} at the end"
        lines.append(alone(part, METHODS.get(ablation, ablation), reached, note=note))
    return lines


def figure(found: Sequence[Curve]) -> Figure:
    """The rate on validation against the seconds of training, a line for each run and a colour for each ablation."""
    drawn = Figure(figsize=(9.5, 4.6), layout="constrained")
    axis = drawn.subplots()
    names = list(dict.fromkeys(one.ablation for one in found))
    for one in found:
        i = names.index(one.ablation)
        label = one.ablation if one is next(other for other in found if other.ablation == one.ablation) else None
        look: dict[str, Any] = {
            "color": COLOURS[i % len(COLOURS)],
            "marker": MARKERS[i % len(MARKERS)],
            "ms": 4,
            "lw": 1.2,
        }
        axis.plot(one.seconds, [count / one.total for count in one.counts], label=label, **look)
    axis.axhline(RATE, color=MARK, ls="--", lw=1)
    where = "axes fraction", "data"
    axis.annotate(f"{RATE}: the paper's ConFlow", (1, RATE), (-4, 4), where, "offset points", ha="right", color=MARK)
    axis.set_yscale("symlog", linthresh=0.01)
    axis.set(xlabel="seconds of training", ylabel="robot-collision rate on validation, no guidance")
    axis.set_ylim(bottom=-5e-4)
    hardware = " and ".join(sorted({one.hardware for one in found}))
    axis.set_title(f"{found[0].total} samples a validation; {hardware}")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, ncols=2)
    return drawn
