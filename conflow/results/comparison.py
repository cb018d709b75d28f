"""The paper's tables and claims and tables of our own, filled from finished runs or from the records of them alone."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from conflow.errors import ConfigError, brief, nearest
from conflow.results import paper, records
from conflow.results.claims import Claim, claims
from conflow.results.records import Record
from conflow.results.tables import BASELINE, COLLISIONS, METHODS, Cell, labelled, labels, method, named, tables
from conflow.tracking import code, store
from conflow.training import config
from conflow.training.config import PAPERS_TASK, SPLITS, SplitName
from conflow.training.evaluation import UNCHANGED


@dataclass(frozen=True)
class Comparison:
    """The cells of all tables of a task at one preset, the claims, which runs they are of, and how to make a row again.

    Attributes:
        commands: what makes a row again, by its name.
        reading: how the paper was read, in settings; rows that were read otherwise say so.
        reasons: why rows differ from the paper's, for those that do.
        code: which runs are of other code than the present or, of published ones, of other code or data than the others
            of their row.
        split: whose starts and goals the models were given; rows without a model are always of the test split.
        left_out: the names of finished runs that were not measured on it.
        others: finished runs at the preset that are of other tasks, data or settings.
        task: as `TASK=` names it.
    """

    preset: str
    cells: list[Cell]
    claims: list[Claim]
    runs: dict[str, list[str]]
    commands: dict[str, str]
    reading: str
    reasons: dict[str, str]
    code: str
    split: SplitName
    left_out: list[str]
    others: list[str]
    task: str = PAPERS_TASK


def collect(preset: str, arguments: Sequence[str] = (), split: SplitName = "val") -> Comparison:
    """Compare the newest finished run of every ablation and seed at a preset, with arguments as they were trained.

    Where runs of the present code have finished, the newest of these.

    Raises:
        ConfigError: there is no such run, or none was measured on this split.
    """
    if split not in SPLITS:
        raise ConfigError(f"split={brief(split)}: expected one of {', '.join(SPLITS)}{nearest(split, list(SPLITS))}")
    found = records.from_store(preset, arguments)
    if not found:
        wanted = " ".join([f"preset={preset}", *arguments])
        others = records.others(preset, [])
        there = f"; there are {', '.join(others[:5])}" if others else ""
        again = " ".join([f"make ablations PRESET={preset}", *_in_make(arguments)])
        raise ConfigError(f"{wanted}: no such run has finished in {store.place()}{there}; try: {again}")
    measured = [one.on(split) for one in found if one.measured(split)]
    if not measured:
        raise ConfigError(
            f"preset={preset}: no finished run was measured on the {SPLITS[split]} split, as those from before it was "
            f"part of a run were not; try: split=test"
        )
    left_out = [one.name for one in found if not one.measured(split)]
    rows = _grouped(measured, lambda one: one.ablation)
    of_code = _of_other_code(one for of_row in rows.values() for one in of_row)
    return _comparison(preset, rows, {}, of_code, split, left_out, records.others(preset, found))


def _in_make(arguments: Sequence[str]) -> list[str]:
    """Arguments of `config.load` as variables of make."""
    tasks = [argument.replace("task=", "TASK=", 1) for argument in arguments if argument.startswith("task=")]
    others = [argument for argument in arguments if not argument.startswith("task=")]
    return tasks + [f"ARGS='{' '.join(others)}'"] * bool(others)


def collect_reference() -> list[Comparison]:
    """Compare the records under runs/reference/ on test, each task's for themselves, the paper's first.

    Preset by preset from the one of the most training down. One that has changed runs alone, with nothing to compare
    them with, comes last.

    Raises:
        ConfigError: there are none.
    """
    places: dict[tuple[str, str], list[Record]] = {}
    for one in records.from_files():
        places.setdefault((one.chosen, one.preset), []).append(one.on("test"))
    found = [_of_records(of_place) for of_place in places.values()]
    return sorted(found, key=lambda one: (one.task != PAPERS_TASK, one.task, _changed_alone(one), -_scale(one.preset)))


def _of_records(published: Sequence[Record]) -> Comparison:
    """Compare records of one task at one preset."""
    counted, beside = _apart(published)
    runs = _grouped([one for one in counted if one.of_preset], lambda one: one.ablation)
    changed = [one for one in counted if not one.of_preset]
    readings = _grouped(changed, lambda one: method(one.ablation, [one]))
    readings |= _grouped(beside, lambda one: f"{method(one.ablation, [])}, {' '.join(one.changes)}")
    found = _comparison(published[0].preset, runs, readings, _mixed(runs | readings), "test", [])
    return found if found.task == PAPERS_TASK else _with_task(found)


def _apart(published: Iterable[Record]) -> tuple[list[Record], list[Record]]:
    """Records that count, one for each ablation, seed and reading, and those that stand beside them.

    In which precision a network was trained is a matter of the machine and no reading of the paper. So a run in bf16
    counts for its seed, unless there is one in single precision; then it stands beside it as a changed one.
    """
    counted: dict[tuple[str, ...], Record] = {}
    beside = []
    for one in sorted(published, key=lambda one: len(one.changes)):
        if counted.setdefault((one.ablation, str(one.seed), *one.reading), one) is not one:
            beside.append(one)
    return list(counted.values()), beside


def _with_task(found: Comparison) -> Comparison:
    """The same with the task in the name of every row, as rows of other tasks stand beside them."""
    of_task = f", task={found.task}"
    cells = [
        # In Table 2 methods are columns.
        replace(one, column=one.column + of_task) if one.table == "2" else replace(one, row=one.row + of_task)
        for one in found.cells
    ]
    return replace(found, cells=cells, commands={name + of_task: again for name, again in found.commands.items()})


def _changed_alone(found: Comparison) -> bool:
    return all(one.table != "1" for one in found.cells)


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


def _of_other_code(records: Iterable[Record]) -> str:
    """Which of the runs of a store are not of the present code, and in which files they differ."""
    runs: dict[str, list[str]] = {}
    for one in records:
        if files := code.differing(one.origin):
            runs.setdefault(", ".join(files), []).append(one.name)
    shown = [f"{', '.join(names)} ({files})" for files, names in runs.items()]
    return f"Trained by other code than the present: {'; '.join(shown)}" if shown else ""


def _mixed(rows: Mapping[str, list[Record]]) -> str:
    """Which rows of published runs pool several codes or data; which of them is the present one does not matter."""
    return "; ".join(
        said
        for said in (
            _differing(rows, "Rows of runs by different code", lambda one: one.origin.get("code_sha", "unknown")),
            _differing(rows, "Rows of runs on different demonstrations", lambda one: (one.digest or "unknown")[:8]),
            _differing(rows, "Rows of runs of different task files", lambda one: one.settings.get("task_code", "")),
        )
        if said
    )


def _differing(rows: Mapping[str, list[Record]], title: str, of: Callable[[Record], str]) -> str:
    """Which rows have runs that differ in something, and which seeds have what; nothing where there are none."""
    shown = []
    for name, of_row in rows.items():
        seeds: dict[str, list[str]] = {}
        for one in of_row:
            seeds.setdefault(of(one), []).append(f"s{one.seed}")
        if len(seeds) > 1:
            several = "; ".join(f"{', '.join(those)}: {what}" for what, those in seeds.items())
            shown.append(f"{name} ({several})")
    return f"{title}: {', '.join(shown)}" if shown else ""


def _comparison(
    preset: str,
    runs: Mapping[str, list[Record]],
    readings: Mapping[str, list[Record]],
    of_code: str,
    split: SplitName,
    left_out: list[str],
    others: Sequence[str] = (),
) -> Comparison:
    cells = tables(runs, readings)
    rows = dict(runs) | dict(readings)
    first = (rows.get("cgp") or next(iter(rows.values())))[0]
    return Comparison(
        preset,
        cells,
        claims(runs, readings.values()),
        {name: [one.run_id for one in of_row] for name, of_row in rows.items()},
        _commands(runs, readings, split),
        " ".join(f"{key}={first.settings[key]}" for key in paper.OPEN if key in first.settings),
        _reasons(cells),
        of_code,
        split,
        left_out,
        list(others),
        first.chosen,
    )


def _reasons(cells: Iterable[Cell]) -> dict[str, str]:
    """The most likely reasons of the rows that differ from the paper's."""
    none, *_ = COLLISIONS.values()
    found: dict[str, str] = {}
    for ablation, row in METHODS.items():
        above = {one.column: one.value > (one.paper or 0) for one in cells if one.row == row and one.differs}
        unguided = (paper.ABOVE if above[none] else paper.BELOW).get(ablation) if none in above else None
        reasons = [unguided] if unguided else []
        reasons += [paper.GUIDED] if any(is_above for column, is_above in above.items() if column != none) else []
        if reasons:
            found[row] = "; ".join(reasons)
    return found


def _commands(
    runs: Mapping[str, list[Record]], readings: Mapping[str, list[Record]], split: SplitName
) -> dict[str, str]:
    """What makes each row again, by the row's name."""
    found = {named(f"{BASELINE}source {ablation}", of_row): _command(of_row) for ablation, of_row in runs.items()}
    methods = {method(ablation, of_row): of_row for ablation, of_row in runs.items()}
    for name, of_row in {**methods, **readings}.items():
        again = found[name] = _command(of_row)
        for label in labels(of_row):
            seeds = " ".join(str(one.seed) for one in labelled(of_row, label))
            arguments = "" if label == UNCHANGED else f" ARGS='{label.replace(':', '=')}'"
            run = f"{of_row[0].preset}/{of_row[0].name.rpartition('-s')[0]}-s$s"
            run += "" if of_row[0].of_task else f" TASK={of_row[0].chosen}"  # a file, which no run holds
            evaluated = f"for s in {seeds}; do make evaluate RUN={run} SPLIT={split}{arguments}; done"
            found[f"{name}, {label}"] = f"{again} && {evaluated}"
    if "cgp" in runs:
        found[named("default", runs["cgp"])] = _command(runs["cgp"])
    for of_row in list(runs.values())[:1]:
        data = [named(f"{BASELINE}{name}", of_row) for name in ("test data", "feasible test data")]
        found |= dict.fromkeys(data, _command(of_row[:1]))
    return found


def _command(runs: Sequence[Record]) -> str:
    """What makes these runs again, those of each precision in turn."""
    return " && ".join(map(_command_of, _grouped(runs, lambda one: " ".join(one.changes)).values()))


def _command_of(runs: Sequence[Record]) -> str:
    """What makes runs with the same changes again."""
    seeds, one = " ".join(str(of_seed.seed) for of_seed in runs), runs[0]
    # Without the spaces of a list, at which the shell would cut it.
    changes = [change.replace(", ", ",") for change in one.changes]
    arguments = f" ARGS='{' '.join(changes)}'" if changes else ""
    if one.task != PAPERS_TASK:
        arguments = f" TASK={one.chosen}{arguments}"
    return f'make ablations ABLATIONS={one.ablation} SEEDS="{seeds}" PRESET={one.preset}{arguments}'
