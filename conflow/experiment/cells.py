"""The numbers of the tables: each over the seeds of a row, with its interval, count, and the paper's beside it."""

import itertools
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from scipy import stats

from conflow.experiment import paper
from conflow.experiment.metrics import wilson
from conflow.experiment.record import Record

LEVEL = 0.05
"""Rates differ and claims are decided at this level, two-sided."""

METHODS = {
    "cgp": "ConFlow (D+ and D-)",
    "no_negatives": "ConFlow (D+)",
    "fm": "FM (D+)",
    "fm_mixed": "FM (D+ and D-)",
    "gaussian": "ConFlow, Gaussian source",
    "gp": "ConFlow, GP source",
    "covariant": "covariant correction",
    "guided_path": "guided path",
    "repair": "repaired D-",
    "spectral": "spectral network",
    "fitted": "fitted source",
    "end": "correction at the predicted end",
    "few_steps": "few solver steps",
    "plus": "plus: the best together",
}
BASELINE = "no model: "
"""Begins the rows of the sources and of the demonstrations."""
SOURCES = ("cgp", "gaussian", "gp", "spectral", "fitted", "plus")
"""The ablations whose sources differ."""
COLLISIONS = {
    "test/none/robot_collision": "none: robot",
    "test/robot/robot_collision": "robot: robot",
    "test/obstacle/robot_collision": "obstacle: robot",
    "test/obstacle/object_collision": "obstacle: object",
    "test/none/object_collision": "none: object",
}
QUALITIES = {
    "test/none/robot_collision": "collision rate",
    "test/none/smoothness_median": "smoothness, median",
    "test/none/smoothness_p95": "smoothness, 95th percentile",
    "test/none/start_error": "start error per robot",
    "test/none/end_error": "end error per robot",
}
# The other readings of smoothness; the paper prints numbers of one, and does not say of which.
SMOOTHNESS = {
    "test/none/peak_acceleration_median": "largest second difference, median",
    "test/none/peak_acceleration_p95": "largest second difference, 95th percentile",
    "test/none/squared_acceleration_median": "squared second difference, median",
    "test/none/squared_acceleration_p95": "squared second difference, 95th percentile",
}
# Whether a low collision rate was bought with something else.
GUARDS = {
    "test/none/robot_collision": "robot-collision rate",
    "test/none/energy_distance": "energy distance to held-out D+",
    "test/none/diversity": "diversity",
    "test/none/smoothness_median": "smoothness, median",
    "test/none/path_length_median": "path length, median",
    "test/none/success": "success rate",
    "test/none/outside": "outside rate",
}
READINGS = {
    "none/robot_collision": "none: robot",
    "robot/robot_collision": "robot: robot",
    "obstacle/robot_collision": "obstacle: robot",
    "obstacle/object_collision": "obstacle: object",
    "none/smoothness_median": "smoothness, median",
    "none/start_error": "start error per robot",
}


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        value, low, high: of a rate the pooled one with Wilson's interval; else the mean over seeds, with the one that
            follows from theirs.
        seed_low, seed_high: the smallest and the largest of the seeds.
        count: trajectories that the rate counts, over all seeds, of a rate.
        trajectories: over all seeds.
        preset: the scale that it was measured at.
        paper_p: of Fisher's exact test between this rate and the paper's.
    """

    table: str
    row: str
    column: str
    paper: float | None
    value: float
    low: float | None
    high: float | None
    seed_low: float
    seed_high: float
    seeds: int
    count: int | None
    trajectories: int
    preset: str
    paper_p: float | None

    @property
    def without_model(self) -> bool:
        """Whether this is of a source or of demonstrations."""
        return self.row.startswith(BASELINE)

    @property
    def differs(self) -> bool:
        """Whether this is another rate than the paper's."""
        return self.paper_p is not None and self.paper_p < LEVEL


def tables(runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]]) -> list[Cell]:
    """The cells of all tables.

    Args:
        runs: by ablation, a run for each seed.
        readings: runs with changed settings, by what is changed.
    """
    cells = [*_table_1(runs), *_table_2(runs), *_table_3(runs), *_table_4(runs, readings)]
    return [cell for cell in cells if cell is not None]


def _table_1(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells = []
    for ablation, by_seed in runs.items():
        printed = itertools.chain(paper.TABLE_1.get(ablation, ()), itertools.repeat(None))
        for (metric, column), number in zip(COLLISIONS.items(), printed, strict=False):
            cells.append(cell("1", METHODS.get(ablation, ablation), column, number, metric, by_seed))
    return cells + _without_model("1", COLLISIONS, runs)


def _table_2(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells = []
    for ablation in [name for name in paper.TABLE_2 if name in runs]:
        printed = itertools.chain(paper.TABLE_2[ablation], itertools.repeat(None))
        for (metric, row), number in zip((QUALITIES | SMOOTHNESS).items(), printed, strict=False):
            cells.append(cell("2", row, METHODS[ablation], number, metric, runs[ablation]))
    return cells


def _table_3(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells = [
        cell("3", METHODS.get(ablation, ablation), column, None, metric, by_seed)
        for ablation, by_seed in runs.items()
        for metric, column in GUARDS.items()
    ]
    return cells + _without_model("3", GUARDS, runs)


def _table_4(runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]]) -> list[Cell | None]:
    """ConFlow under other readings: trained with them, or, where that is enough, sampled and judged again with them."""
    rows = [("default", "test/", runs.get("cgp", [])), *((name, "test/", of_row) for name, of_row in readings.items())]
    for name, of_row in runs.items():
        rows += [(f"{METHODS.get(name, name)}, {label}", f"evaluate/{label}/", of_row) for label in labels(of_row)]
    if len(rows) == 1:
        return []
    return [
        cell("4", row, column, None, prefix + metric, of_row)
        for row, prefix, of_row in rows
        for metric, column in READINGS.items()
    ]


def _without_model(table: str, columns: Mapping[str, str], runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    """Rows of the sources and of the demonstrations, in those of the columns that are without guidance."""
    every = [run for by_seed in runs.values() for run in by_seed]
    rows = [(f"source {name}", "source", runs[name]) for name in SOURCES if name in runs]
    rows += [("test data", "data", every), ("feasible test data", "feasible", every)]
    cells = []
    for row, group, of_row in rows:
        for metric, column in columns.items():
            if metric.startswith("test/none/"):
                baseline = metric.replace("test/none/", f"without_model/{group}/")
                # The same demonstrations for every run, so they are counted once.
                chosen = of_row if group == "source" else [run for run in every if _measured(baseline, [run])][:1]
                cells.append(cell(table, f"{BASELINE}{row}", column, None, baseline, chosen))
    return cells


def _measured(metric: str, runs: Sequence[Record]) -> bool:
    """Whether all runs, some perhaps logged before there was this metric, have it or the count behind it."""
    return all(metric in run.metrics or f"{metric}_count" in run.metrics for run in runs)


def cell(table: str, row: str, column: str, printed: float | None, metric: str, runs: Sequence[Record]) -> Cell | None:
    """The number over the seeds of a row, beside the paper's, or None where a run lacks the metric."""
    if not runs or not _measured(metric, runs):
        return None
    values, trajectories = per_seed(metric, runs), sum(_trajectories(metric, run) for run in runs)
    value, count, paper_p = statistics.mean(values), None, None
    if f"{metric}_count" not in runs[0].metrics:
        low, high = _interval(value, metric, runs)
    else:
        count = sum(int(run.metrics[f"{metric}_count"]) for run in runs)
        value = count / trajectories
        low, high = wilson(count, trajectories)
        if printed is not None and table == "1":
            paper_p = fisher_p(count, trajectories, round(printed * paper.TRAJECTORIES), paper.TRAJECTORIES)
    across = (min(values), max(values), len(runs), count, trajectories, runs[0].preset, paper_p)
    return Cell(table, row, column, printed, value, low, high, *across)


def _interval(value: float, metric: str, runs: Sequence[Record]) -> tuple[float | None, float | None]:
    """Of a mean over seeds: the distances to the ends of the seeds' own intervals, as independent errors of a mean."""
    ends = [(run.metrics.get(f"{metric}_low"), run.metrics[metric], run.metrics.get(f"{metric}_high")) for run in runs]
    known = [(middle - low, high - middle) for low, middle, high in ends if low is not None and high is not None]
    if len(known) < len(runs):
        return None, None
    below, above = (math.hypot(*distances) / len(runs) for distances in zip(*known, strict=True))
    return value - below, value + above


def per_seed(metric: str, runs: Sequence[Record]) -> list[float]:
    """The metric of each run, a rate from its count."""
    return [
        run.metrics[f"{metric}_count"] / _trajectories(metric, run)
        if f"{metric}_count" in run.metrics
        else run.metrics[metric]
        for run in runs
    ]


def _trajectories(metric: str, run: Record) -> int:
    return int(run.metrics[metric.rsplit("/", 1)[0] + "/num"])


def labels(runs: Sequence[Record]) -> list[str]:
    """The settings that runs were sampled with again."""
    return sorted({key.split("/")[1] for one in runs for key in one.metrics if key.startswith("evaluate/")})


def fisher_p(count: int, trajectories: int, other_count: int, other_trajectories: int) -> float:
    """The p of Fisher's exact test between two rates."""
    table = [[count, trajectories - count], [other_count, other_trajectories - other_count]]
    return float(stats.fisher_exact(table).pvalue)


def digits(value: float) -> str:
    """Four decimals; of what would lose its digits so, two of them."""
    return f"{value:.2g}" if 0 < abs(value) < 1e-3 else f"{value:.4f}"
