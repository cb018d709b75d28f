"""The numbers of the tables: each over the seeds of a row, with its interval, count, and the paper's beside it."""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from conflow.results import paper, statistics
from conflow.results.records import DEMONSTRATED, Record
from conflow.results.statistics import Score, Seed
from conflow.training.config import PAPERS_TASK, SWAPS
from conflow.training.metrics import wilson

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
    "descent": "descent at sampling, none in training",
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
    "test/robot/energy_distance": "robot: energy distance to held-out D+",
    "test/none/diversity": "diversity",
    "test/none/smoothness_median": "smoothness, median",
    "test/none/path_length_median": "path length, median",
    "test/none/success": "success rate",
    "test/none/outside": "outside rate",
    "test/none/near": "near rate",
}
# On demonstrations of other seeds and kinds: what is kept under every setting, and how near to D+ it comes.
ELSEWHERE = {
    "test/none/robot_collision": "none: robot",
    "test/robot/robot_collision": "robot: robot",
    "test/obstacle/robot_collision": "obstacle: robot",
    "test/obstacle/object_collision": "obstacle: object",
    "test/none/success": "none: success",
    "test/robot/success": "robot: success",
    "test/obstacle/success": "obstacle: success",
    "test/none/near": "near rate",
    "test/none/smoothness_median": "smoothness, median",
    "test/none/energy_distance": "energy distance to held-out D+",
    "test/robot/energy_distance": "robot: energy distance to held-out D+",
}
ALSO_READ = {"none/smoothness_median": "smoothness, median", "none/start_error": "start error per robot"}
READINGS = {
    "none/robot_collision": "none: robot",
    "robot/robot_collision": "robot: robot",
    "obstacle/robot_collision": "obstacle: robot",
    "obstacle/object_collision": "obstacle: object",
    **ALSO_READ,
}
Interval = tuple[float | None, float | None]
NONE: Interval = (None, None)
SHARED = "/energy_distance"
"""Ends the metrics whose error the seeds share: they are measured against one sample of held-out D+."""


@dataclass(frozen=True)
class Cell:
    """One number of a table.

    Attributes:
        value: of a rate that of all trajectories together, else the mean over seeds.
        low, high: its interval over seeds, which is of the method; none where there is one seed alone. Without a
            network every trajectory is independent, and it is the same as `within_low` and `within_high`.
        within_low, within_high: the interval of these networks' own mean, which says nothing of others: Wilson's of a
            rate, else the one that follows from theirs.
        seed_low, seed_high: the smallest and the largest of the seeds.
        count: trajectories that the rate counts, over all seeds, of a rate.
        trajectories: over all seeds.
        preset: the scale that it was measured at.
        machine: the precision and the hardware that its networks were trained in and on, by seed where they differ.
        differs: whether the paper's rate is another than one new network of this method would reach in as many
            trajectories; none where that is not judged.
    """

    table: str
    row: str
    column: str
    paper: float | None
    value: float
    low: float | None
    high: float | None
    within_low: float | None
    within_high: float | None
    seed_low: float
    seed_high: float
    seeds: int
    count: int | None
    trajectories: int
    preset: str
    machine: str
    differs: bool | None

    @property
    def without_model(self) -> bool:
        """Whether this is of a source or of demonstrations."""
        return self.row.startswith(BASELINE)

    @property
    def interval(self) -> Interval:
        """Over seeds, or of one seed within its network."""
        return (self.low, self.high) if self.low is not None else (self.within_low, self.within_high)


def tables(runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]]) -> list[Cell]:
    """The cells of all tables.

    Args:
        runs: by ablation, a run for each seed.
        readings: runs with changed settings, by what is changed.
    """
    elsewhere = {name: of_row for name, of_row in readings.items() if _on_other_data(of_row[0])}
    read = {name: of_row for name, of_row in readings.items() if name not in elsewhere}
    cells = [*_table_1(runs), *_table_2(runs), *_table_3(runs), *_table_4(runs, read), *_table_5(elsewhere)]
    return [cell for cell in cells if cell is not None]


def named(name: str, runs: Sequence[Record]) -> str:
    """A row's name, of changed runs with what is changed about them."""
    return name if not runs or runs[0].of_preset else f"{name}, {' '.join(runs[0].reading)}"


def method(ablation: str, runs: Sequence[Record]) -> str:
    """The name of a method's row."""
    return named(METHODS.get(ablation, ablation), runs)


def collisions(runs: Mapping[str, list[Record]]) -> Mapping[str, str]:
    """The columns of collision rates: the paper's, or of another task's each setting with each constraint."""
    every = [run for by_seed in runs.values() for run in by_seed]
    if not every or every[0].task in SWAPS:
        return COLLISIONS
    found = (re.fullmatch(r"test/([^/]+)/(.+)_collision_count", key) for run in every for key in run.metrics)
    names = sorted({(one[1] != "none", one[1], one[2]) for one in found if one})
    return {f"test/{setting}/{name}_collision": f"{setting}: {name}" for _, setting, name in names}


def _table_1(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells = []
    columns = collisions(runs)
    for ablation, by_seed in runs.items():
        for (metric, column), number in zip(columns.items(), _printed(paper.TABLE_1, by_seed), strict=False):
            cells.append(cell("1", method(ablation, by_seed), column, number, metric, by_seed))
    return cells + _without_model("1", columns, runs)


def _table_2(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells: list[Cell | None] = []
    if collisions(runs) is not COLLISIONS:
        return cells
    for ablation in [name for name in paper.TABLE_2 if name in runs]:
        numbers = _printed(paper.TABLE_2, runs[ablation])
        for (metric, row), number in zip((QUALITIES | SMOOTHNESS).items(), numbers, strict=False):
            cells.append(cell("2", row, method(ablation, runs[ablation]), number, metric, runs[ablation]))
    return cells


def _printed(numbers: Mapping[str, Sequence[float]], by_seed: Sequence[Record]) -> Iterator[float | None]:
    """The paper's numbers for a method, and none after them; of another task or changed settings there is none."""
    of_paper = by_seed[0].task == PAPERS_TASK and by_seed[0].of_preset
    return itertools.chain(numbers.get(by_seed[0].ablation, ()) if of_paper else (), itertools.repeat(None))


def _table_3(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells = [
        cell("3", method(ablation, by_seed), column, None, metric, by_seed)
        for ablation, by_seed in runs.items()
        for metric, column in GUARDS.items()
    ]
    return cells + _without_model("3", GUARDS, runs)


def _table_4(runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]]) -> list[Cell | None]:
    """ConFlow under other readings: trained with them, or, where that is enough, sampled and judged again with them."""
    rows = [(named("default", runs.get("cgp", [])), "test/", runs.get("cgp", []))]
    for name, of_row in readings.items():
        rows += [(name, "test/", of_row), *_sampled_again(name, of_row)]
    for name, of_row in runs.items():
        rows += _sampled_again(method(name, of_row), of_row)
    if len(rows) == 1:
        return []
    return [
        cell("4", row, column, None, prefix + metric, of_row)
        for row, prefix, of_row in rows
        for metric, column in _of_readings({**runs, **readings}).items()
    ]


def _sampled_again(name: str, of_row: Sequence[Record]) -> list[tuple[str, str, list[Record]]]:
    """A row for each settings that runs were sampled with again: its name, how its metrics begin, and its runs."""
    return [(f"{name}, {label}", f"evaluate/{label}/", labelled(of_row, label)) for label in labels(of_row)]


def _of_readings(runs: Mapping[str, list[Record]]) -> Mapping[str, str]:
    """The columns of Table 4; of another task than a swap all its collisions, and success in every setting."""
    columns = collisions(runs)
    if columns is COLLISIONS:
        return READINGS
    own = {metric.removeprefix("test/"): column for metric, column in columns.items()}
    settings = dict.fromkeys(metric.split("/")[0] for metric in own)
    return own | {f"{setting}/success": f"{setting}: success" for setting in settings} | ALSO_READ


def _on_other_data(run: Record) -> bool:
    """Whether all that is changed about a run is what was demonstrated, and not what it made of that."""
    return bool(run.reading) and all(change.partition("=")[0] in DEMONSTRATED for change in run.reading)


def _table_5(elsewhere: Mapping[str, list[Record]]) -> list[Cell | None]:
    """Methods on other demonstrations, each set with its own D+ below the first of them."""
    cells: list[Cell | None] = []
    every: dict[str, list[Record]] = {}
    for of_row in elsewhere.values():
        every.setdefault(" ".join(of_row[0].reading), []).extend(of_row)
    for name, of_row in elsewhere.items():
        for row, prefix, measured in [(name, "test/", of_row), *_sampled_again(name, of_row)]:
            cells += [
                cell("5", row, column, None, metric.replace("test/", prefix), measured)
                for metric, column in ELSEWHERE.items()
            ]
        changes = " ".join(of_row[0].reading)
        cells += _row_without_model("5", f"feasible, {changes}", "feasible", ELSEWHERE, every.pop(changes, []))
    return cells


def _without_model(table: str, columns: Mapping[str, str], runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    """Rows of the sources and of the demonstrations, in those of the columns that are without guidance."""
    every = [run for by_seed in runs.values() for run in by_seed]
    rows = [(f"source {name}", "source", runs[name]) for name in SOURCES if name in runs]
    rows += [("test data", "data", every), ("feasible test data", "feasible", every)]
    cells = []
    for row, group, of_row in rows:
        cells += _row_without_model(table, named(row, of_row), group, columns, of_row)
    return cells


def _row_without_model(
    table: str, row: str, group: str, columns: Mapping[str, str], runs: Sequence[Record]
) -> list[Cell | None]:
    """A source's row, over all runs, or one of demonstrations, the same for every run and so counted once."""
    cells = []
    for metric, column in columns.items():
        if metric.startswith("test/none/"):
            baseline = metric.replace("test/none/", f"without_model/{group}/")
            chosen = runs if group == "source" else [run for run in runs if _measured(baseline, [run])][:1]
            cells.append(cell(table, f"{BASELINE}{row}", column, None, baseline, chosen))
    return cells


def _measured(metric: str, runs: Sequence[Record]) -> bool:
    """Whether all runs, some perhaps logged before there was this metric, have it or the count behind it."""
    return all(metric in run.metrics or f"{metric}_count" in run.metrics for run in runs)


def cell(table: str, row: str, column: str, printed: float | None, metric: str, runs: Sequence[Record]) -> Cell | None:
    """The number over the seeds of a row, beside the paper's, or None where a run lacks the metric."""
    if not runs or not _measured(metric, runs):
        return None
    count, value, over_seeds, within = (_rate if f"{metric}_count" in runs[0].metrics else _mean)(metric, runs)
    low, high = within if row.startswith(BASELINE) else over_seeds
    differs = None
    if table == "1" and printed is not None and len(runs) > 1:
        the_papers = Score.of_rate(round(printed * paper.TRAJECTORIES), paper.TRAJECTORIES)
        differs = statistics.differs(list(scores(metric, runs).values()), the_papers)
    values, trajectories = [_value(metric, run) for run in runs], sum(_trajectories(metric, run) for run in runs)
    across = (min(values), max(values), len(runs), count, trajectories, runs[0].preset, _machine(runs))
    return Cell(table, row, column, printed, value, low, high, within[0], within[1], *across, differs)


def _machine(runs: Sequence[Record]) -> str:
    """The precision and the hardware of runs, by seed where they differ."""
    seeds: dict[str, list[str]] = {}
    for run in runs:
        seeds.setdefault(run.machine, []).append(f"s{run.seed}")
    if len(seeds) == 1:
        return next(iter(seeds))
    return "; ".join(f"{', '.join(those)}: {machine}" for machine, those in seeds.items())


def _rate(metric: str, runs: Sequence[Record]) -> tuple[int, float, Interval, Interval]:
    """The count of all trajectories, their rate, and its intervals over seeds and within these networks."""
    counts = [int(run.metrics[f"{metric}_count"]) for run in runs]
    totals = [_trajectories(metric, run) for run in runs]
    count, total = sum(counts), sum(totals)
    over_seeds = statistics.rate_interval(counts, totals) if len(runs) > 1 else NONE
    return count, count / total, over_seeds, wilson(count, total)


def _mean(metric: str, runs: Sequence[Record]) -> tuple[None, float, Interval, Interval]:
    """No count, the mean over seeds, and its intervals over seeds and within these networks.

    Errors of the runs add up in squares where they are independent; shared ones are as large in the mean as in each.
    """
    values, shared = [run.metrics[metric] for run in runs], metric.endswith(SHARED)
    mean, below, above = fmean(values), 0.0, 0.0
    ends = [(run.metrics.get(f"{metric}_low"), run.metrics[metric], run.metrics.get(f"{metric}_high")) for run in runs]
    known = [(middle - low, high - middle) for low, middle, high in ends if low is not None and high is not None]
    if complete := len(known) == len(runs):
        below, above = (fmean(one) if shared else math.hypot(*one) / len(one) for one in zip(*known, strict=True))
    within = (mean - below, mean + above) if complete else NONE
    if len(runs) == 1:
        return None, mean, NONE, within
    return None, mean, statistics.mean_interval(values, *((below, above) if shared else (0.0, 0.0))), within


def scores(metric: str, runs: Sequence[Record]) -> dict[Seed, Score]:
    """What each run reached, on the scale of the tests."""
    return {(run.seed, run.digest): _score(metric, run) for run in runs}


def _score(metric: str, run: Record) -> Score:
    count = run.metrics.get(f"{metric}_count")
    return Score(run.metrics[metric]) if count is None else Score.of_rate(count, _trajectories(metric, run))


def _value(metric: str, run: Record) -> float:
    """The metric of a run, a rate from its count."""
    count = run.metrics.get(f"{metric}_count")
    return run.metrics[metric] if count is None else count / _trajectories(metric, run)


def _trajectories(metric: str, run: Record) -> int:
    return int(run.metrics[metric.rsplit("/", 1)[0] + "/num"])


def labelled(runs: Sequence[Record], label: str) -> list[Record]:
    """Those of the runs that were sampled again with these settings."""
    return [one for one in runs if any(key.startswith(f"evaluate/{label}/") for key in one.metrics)]


def labels(runs: Sequence[Record]) -> list[str]:
    """The settings that runs were sampled with again."""
    return sorted({key.split("/")[1] for one in runs for key in one.metrics if key.startswith("evaluate/")})
