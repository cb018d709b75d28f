"""The paper's tables and claims and tables of our own, filled from finished runs or from the records of them alone."""

import itertools
import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from scipy import stats

from conflow.experiment import config, record
from conflow.experiment.config import ConfigError
from conflow.experiment.metrics import wilson
from conflow.experiment.record import Record

Verdict = Literal["holds", "reversed", "not distinguishable", "too few seeds", "no runs"]
LEVEL = 0.05
"""Claims are tested at this level, two-sided."""

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
PAPER_TRAJECTORIES = 256
"""Of which the paper's rates in Table 1 are the fractions."""
# What the paper prints, Table 1 by row and Table 2 by column. Its FM (D+ and D-) cells for no and for robot guidance
# look exchanged: a model of data of which 30 % collide cannot give 0.055 unguided.
PAPER_1 = {
    "cgp": (0.016, 0.004, 0.000, 0.035),
    "no_negatives": (0.043, 0.004, 0.035, 0.074),
    "fm": (0.031, 0.020, 0.039, 0.039),
    "fm_mixed": (0.055, 0.270, 0.281, 0.059),
}
PAPER_2 = {
    "gaussian": (0.0288, 0.0678, 0.2218, 0.0267, 0.0276),
    "cgp": (0.0156, 0.0174, 0.0309, 0.0006, 0.0006),
}


# Why a row differs from the paper's, most likely, and where to see it: without guidance, and guided.
UNGUIDED = {
    "cgp": "too short a training: the filter pushes x_t to where the source has no mass (make explain: support), and "
    "the network learns only late to bring it back; preset long is long enough",
    "no_negatives": "lower than the paper's: a narrower network at a one-cycle rate may fit D+ more closely",
    "fm": "from a standard normal the ends and the smoothness have to be learned (start error of the Gaussian source "
    "in Table 2), and feasibility with them",
    "fm_mixed": "a model of demonstrations of which 30 % collide cannot give the paper's 0.055 unguided: its cells for "
    "no and for robot guidance look exchanged",
}
GUIDED = (
    "guided: the paper does not say where its obstacle stands, and through this one half of the demonstrations pass; a "
    "larger weight does more (make figures: guidance_weight), and after few steps of training the flow pulls back what "
    "is pushed (guidance)"
)
OPEN = (
    *("constraint.reduction", "correction.smoothing", "correction.edges", "correction.keep_ends", "correction.mask"),
    *("network.sees_ends", "sample.solver", "sample.steps", "sample.radius", "data.amplitudes", "data.jitter"),
)
"""The settings by which the paper is read."""


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
    def differs(self) -> bool:
        """Whether this is another rate than the paper's."""
        return self.paper_p is not None and self.paper_p < LEVEL


@dataclass(frozen=True)
class Claim:
    """A sentence "a is lower than b", and what the runs say to it.

    Attributes:
        verdict: of a rate by Fisher's exact test on the counts, else by the test between seeds.
        p: of Fisher's exact test, of a rate. It speaks of the networks that were trained, not of others.
        seeds_p: of Welch's t test on the values of the seeds; none where there are too few to have a spread.
    """

    text: str
    verdict: Verdict
    p: float | None
    seeds_p: float | None
    detail: str


@dataclass(frozen=True)
class Comparison:
    """The cells of all tables at one preset, the claims, which runs they come from, and how to make a row again.

    Attributes:
        commands: what makes a row again, by its name.
        reading: how the paper was read, in settings; rows that were read otherwise say so.
        reasons: why rows differ from the paper's, for those that do.
    """

    preset: str
    cells: list[Cell]
    claims: list[Claim]
    runs: dict[str, list[str]]
    commands: dict[str, str]
    reading: str
    reasons: dict[str, str]


def collect(preset: str, arguments: Sequence[str] = ()) -> Comparison:
    """Compare the newest finished run of every ablation and seed at a preset, with arguments as they were trained.

    Raises:
        ConfigError: there is no such run.
    """
    records = record.from_store(preset, arguments)
    if not records:
        raise ConfigError(f"preset={preset}: no run at this preset has finished; try: make ablations PRESET={preset}")
    return _comparison(preset, _grouped(records, lambda one: one.ablation), {})


def collect_reference() -> list[Comparison]:
    """Compare the records under runs/reference/, preset by preset from the one of the most training down.

    A preset that has changed runs alone, with nothing to compare them with, comes last.

    Raises:
        ConfigError: there are none.
    """
    records = record.from_files()
    found = []
    for preset in sorted({one.preset for one in records}, key=_scale, reverse=True):
        plain = [one for one in records if one.preset == preset and not one.changes()]
        changed = [one for one in records if one.preset == preset and one.changes()]
        found.append(_comparison(preset, _grouped(plain, lambda one: one.ablation), _grouped(changed, _reading)))
    return sorted(found, key=lambda one: not one.claims)


def _scale(preset: str) -> int:
    """How much is computed in a training at a preset, about."""
    settings = config.load([f"preset={preset}"])
    return settings.train.max_steps * settings.train.batch_size * settings.network.hidden**2


def _grouped(records: Iterable[Record], name: Callable[[Record], str]) -> dict[str, list[Record]]:
    """Records by name, those of METHODS first and in their order."""
    rank = {ablation: i for i, ablation in enumerate(METHODS)}
    groups: dict[str, list[Record]] = {}
    for one in sorted(records, key=lambda one: (rank.get(one.ablation, len(rank)), name(one), one.seed)):
        groups.setdefault(name(one), []).append(one)
    return groups


def _reading(one: Record) -> str:
    """The name of a row for a changed run: all that sets it apart from the row without changes."""
    return f"{METHODS.get(one.ablation, one.ablation)}, {' '.join(one.changes())}"


def _comparison(preset: str, runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]]) -> Comparison:
    cells = [*_table_1(runs), *_table_2(runs), *_table_3(runs), *_table_4(runs, readings)]
    rows = dict(runs) | dict(readings)
    settings = (rows.get("cgp") or next(iter(rows.values())))[0].settings
    return Comparison(
        preset,
        [cell for cell in cells if cell is not None],
        _claims(runs) if runs else [],
        {name: [one.run_id for one in of_row] for name, of_row in rows.items()},
        _commands(runs, readings),
        " ".join(f"{key}={settings[key]}" for key in OPEN if key in settings),
        _reasons(cells),
    )


def _reasons(cells: Iterable[Cell | None]) -> dict[str, str]:
    """The most likely reasons of the rows that differ from the paper's."""
    none, *_ = COLLISIONS.values()
    found: dict[str, str] = {}
    for ablation, row in METHODS.items():
        differing = {cell.column for cell in cells if cell is not None and cell.row == row and cell.differs}
        reasons = [UNGUIDED[ablation]] if none in differing and ablation in UNGUIDED else []
        reasons += [GUIDED] if differing - {none} else []
        if reasons:
            found[row] = "; ".join(reasons)
    return found


def _commands(runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]]) -> dict[str, str]:
    """What makes each row again, by the row's name."""
    found = {name: _command(of_row) for name, of_row in readings.items()}
    for ablation, of_row in runs.items():
        name, again = METHODS.get(ablation, ablation), _command(of_row)
        found |= {name: again, f"no model: source {ablation}": again}
        seeds = " ".join(str(one.seed) for one in of_row)
        for label in _labels(of_row):
            arguments = "" if label == record.UNCHANGED else f" ARGS='{label.replace(':', '=')}'"
            evaluated = f"for s in {seeds}; do make evaluate RUN={of_row[0].preset}/{ablation}-s$s{arguments}; done"
            found[f"{name}, {label}"] = f"{again} && {evaluated}"
    if "cgp" in runs:
        found["default"] = _command(runs["cgp"])
    for of_row in list(runs.values())[:1]:
        found |= dict.fromkeys(("no model: test data", "no model: feasible test data"), _command(of_row[:1]))
    return found


def _labels(runs: Sequence[Record]) -> list[str]:
    """The settings that runs were sampled with again."""
    return sorted({key.split("/")[1] for one in runs for key in one.metrics if key.startswith("evaluate/")})


def _command(runs: Sequence[Record]) -> str:
    """What makes these runs again."""
    seeds, one = " ".join(str(of_seed.seed) for of_seed in runs), runs[0]
    # Without the spaces of a list, at which the shell would cut it.
    changes = [change.replace(", ", ",") for change in one.changes()]
    arguments = f" ARGS='{' '.join(changes)}'" if changes else ""
    return f'make ablations ABLATIONS={one.ablation} SEEDS="{seeds}" PRESET={one.preset}{arguments}'


def _table_1(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells = []
    for ablation, by_seed in runs.items():
        papers = itertools.chain(PAPER_1.get(ablation, ()), itertools.repeat(None))
        for (metric, column), paper in zip(COLLISIONS.items(), papers, strict=False):
            cells.append(_cell("1", METHODS.get(ablation, ablation), column, paper, metric, by_seed))
    return cells + _without_model("1", COLLISIONS, runs)


def _table_2(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    return [
        _cell("2", row, METHODS[ablation], paper, metric, runs[ablation])
        for ablation, papers in PAPER_2.items()
        if ablation in runs
        for (metric, row), paper in zip(
            (QUALITIES | SMOOTHNESS).items(), (*papers, *itertools.repeat(None, len(SMOOTHNESS))), strict=True
        )
    ]


def _table_3(runs: Mapping[str, list[Record]]) -> list[Cell | None]:
    cells = [
        _cell("3", METHODS.get(ablation, ablation), column, None, metric, by_seed)
        for ablation, by_seed in runs.items()
        for metric, column in GUARDS.items()
    ]
    return cells + _without_model("3", GUARDS, runs)


def _table_4(runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]]) -> list[Cell | None]:
    """ConFlow under other readings: trained with them, or, where that is enough, sampled and judged again with them."""
    rows = [("default", "test/", runs.get("cgp", [])), *((name, "test/", of_row) for name, of_row in readings.items())]
    for name, of_row in runs.items():
        rows += [(f"{METHODS.get(name, name)}, {label}", f"evaluate/{label}/", of_row) for label in _labels(of_row)]
    if len(rows) == 1:
        return []
    return [
        _cell("4", row, column, None, prefix + metric, of_row)
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
                cells.append(_cell(table, f"no model: {row}", column, None, baseline, chosen))
    return cells


def _measured(metric: str, runs: Sequence[Record]) -> bool:
    """Whether all runs, some perhaps logged before there was this metric, have it or the count behind it."""
    return all(metric in run.metrics or f"{metric}_count" in run.metrics for run in runs)


def _cell(table: str, row: str, column: str, paper: float | None, metric: str, runs: Sequence[Record]) -> Cell | None:
    """The number, or None where a run lacks the metric."""
    if not runs or not _measured(metric, runs):
        return None
    values, trajectories = _values(metric, runs), sum(_trajectories(metric, run) for run in runs)
    value, count, paper_p = statistics.mean(values), None, None
    if f"{metric}_count" not in runs[0].metrics:
        low, high = _interval(value, metric, runs)
    else:
        count = sum(int(run.metrics[f"{metric}_count"]) for run in runs)
        value = count / trajectories
        low, high = wilson(count, trajectories)
        if paper is not None and table == "1":
            paper_p = _fisher_p(count, trajectories, round(paper * PAPER_TRAJECTORIES), PAPER_TRAJECTORIES)
    across = (min(values), max(values), len(runs), count, trajectories, runs[0].preset, paper_p)
    return Cell(table, row, column, paper, value, low, high, *across)


def _interval(value: float, metric: str, runs: Sequence[Record]) -> tuple[float | None, float | None]:
    """Of a mean over seeds: the distances to the ends of the seeds' own intervals, as independent errors of a mean."""
    ends = [(run.metrics.get(f"{metric}_low"), run.metrics[metric], run.metrics.get(f"{metric}_high")) for run in runs]
    known = [(middle - low, high - middle) for low, middle, high in ends if low is not None and high is not None]
    if len(known) < len(runs):
        return None, None
    below, above = (math.hypot(*distances) / len(runs) for distances in zip(*known, strict=True))
    return value - below, value + above


def _values(metric: str, runs: Sequence[Record]) -> list[float]:
    """The metric of each run, a rate from its count."""
    return [
        run.metrics[f"{metric}_count"] / _trajectories(metric, run)
        if f"{metric}_count" in run.metrics
        else run.metrics[metric]
        for run in runs
    ]


def _trajectories(metric: str, run: Record) -> int:
    return int(run.metrics[metric.rsplit("/", 1)[0] + "/num"])


def _claims(runs: Mapping[str, list[Record]]) -> list[Claim]:
    """The paper's claims and ours of `plus` in words, each as "a is lower than b"."""
    none, *_ = COLLISIONS
    rates = [
        ("ConFlow collides less than FM, without guidance", "cgp", "fm", none),
        *(
            (f"negatives help ConFlow ({column})", "cgp", "no_negatives", metric)
            for metric, column in list(COLLISIONS.items())[:4]
        ),
        ("naive negatives hurt FM, without guidance", "fm", "fm_mixed", none),
        ("CGP beats Gaussian: collision rate", "cgp", "gaussian", none),
    ]
    others = [(metric, row) for metric, row in QUALITIES.items() if metric != none]
    ours = [
        ("the spectral network lets ConFlow collide less, without guidance", "spectral", "cgp", none),
        ("plus collides less than ConFlow, without guidance", "plus", "cgp", none),
        ("plus collides less than ConFlow (D+), without guidance", "plus", "no_negatives", none),
    ]
    return [
        *(_compare(runs, *claim) for claim in rates),
        *(_compare(runs, f"CGP beats Gaussian: {row}", "cgp", "gaussian", key) for key, row in others),
        *(_compare(runs, *claim) for claim in ours),
    ]


def _compare(runs: Mapping[str, list[Record]], text: str, lower: str, higher: str, metric: str) -> Claim:
    if lower not in runs or higher not in runs:
        missing = " and ".join(name for name in (lower, higher) if name not in runs)
        return Claim(text, "no runs", None, None, f"no finished run of {missing}")
    a, b = (_cell("", "", "", None, metric, runs[name]) for name in (lower, higher))
    if a is None or b is None:
        return Claim(text, "no runs", None, None, f"not all runs of {lower} and {higher} have {metric}")
    seeds_p = _welch_p(_values(metric, runs[lower]), _values(metric, runs[higher]))
    p = None
    if a.count is not None and b.count is not None:
        p = _fisher_p(a.count, a.trajectories, b.count, b.trajectories)
    detail = f"{a.value:.4f} against {b.value:.4f}, {a.seeds} and {b.seeds} seeds"
    return Claim(text, _verdict(a.value, b.value, seeds_p if p is None else p), p, seeds_p, detail)


def _verdict(a: float, b: float, p: float | None) -> Verdict:
    """On "a is lower than b"."""
    if p is None:
        return "too few seeds"
    return "not distinguishable" if p >= LEVEL or a == b else "holds" if a < b else "reversed"


def _fisher_p(count: int, trajectories: int, other_count: int, other_trajectories: int) -> float:
    table = [[count, trajectories - count], [other_count, other_trajectories - other_count]]
    return float(stats.fisher_exact(table).pvalue)


def _welch_p(a: Sequence[float], b: Sequence[float]) -> float | None:
    """The p of Welch's t test, or None where one side is a single value or neither has a spread."""
    if min(len(a), len(b)) < 2 or len(set(a)) == len(set(b)) == 1:
        return None
    moments = [moment for side in (a, b) for moment in (statistics.mean(side), statistics.stdev(side), len(side))]
    return float(stats.ttest_ind_from_stats(*moments, equal_var=False).pvalue)
