"""Scenes of many robots, solved with models and without: records, and what is printed of them beside published ones."""

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import count
from pathlib import Path
from statistics import mean, median

from rich.console import Console

from conflow.errors import ConfigError, brief
from conflow.results import peers, printing
from conflow.results.printing import Format, Sheet
from conflow.scene.tasks import CROWDS
from conflow.tracking import store
from conflow.training.metrics import wilson

FOLDER = store.RUNS / "reference" / "planbench"
HEADINGS = (
    *("method", "solved [95 %]", "s, mean", "median", "worst", "feasible: raw", "guided", "conflicts", "path length"),
    *("smoothness", "adherence", "energy distance"),
)


@dataclass(frozen=True)
class Settings:
    """How scenes are solved.

    Attributes:
        num: candidates at a time.
        limit: seconds a scene, after which it counts as not solved.
        guided: whether what descends was guided before.
        looked: scenes of which raw candidates are judged too, without the clock.
    """

    num: int = 16
    limit: float = 5.0
    guided: bool = False
    looked: int = 32


@dataclass
class Row:
    """What a method did on all scenes.

    Attributes:
        method: its name.
        passed: whether each has a plan that passes the strict audit.
        seconds: of every attempt, solved or not.
        raw_feasible, raw: of so many candidates without guidance how many are feasible.
        guided_feasible, guided: likewise with it, before descent.
        conflicts: mean number of pairs that collide in a candidate without guidance.
        path_length, smoothness: medians over solved scenes.
        adherence: share of waypoints near their robot's straight line.
        energy_distance: of single robots' trajectories to their own demonstrations, with its interval.
    """

    method: str
    passed: list[bool] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    raw_feasible: int = 0
    raw: int = 0
    guided_feasible: int = 0
    guided: int = 0
    conflicts: float | None = None
    path_length: float | None = None
    smoothness: float | None = None
    adherence: float | None = None
    energy_distance: list[float] | None = None

    @property
    def solved(self) -> int:
        """How many scenes."""
        return sum(self.passed)

    @property
    def scenes(self) -> int:
        """Of how many."""
        return len(self.passed)


@dataclass(frozen=True)
class Record:
    """One run of the benchmark.

    Attributes:
        plan: of the first scene by the last method that solved it as long as the task says, (T, 2 robots).
    """

    task: str
    robots: int
    seed: int
    settings: dict[str, float]
    hardware: str
    rows: list[Row]
    plan: list[list[float]] = field(default_factory=list)


PICTURES = (".png", ".gif")
"""What is drawn beside a record."""


def write(record: Record, folder: Path) -> Path:
    """A new file of this record in a folder that exists: TASK-ROBOTS.json, or numbered where it or its picture does."""
    names = (f"{record.task}-{record.robots}{f'-{i}' if i > 1 else ''}.json" for i in count(1))
    paths = (folder / name for name in names)
    path = next(path for path in paths if not any(path.with_suffix(kind).exists() for kind in (".json", *PICTURES)))
    path.write_text(json.dumps(asdict(record), indent=1) + "\n")
    return path


def read(path: Path) -> Record:
    """The record that `write` left.

    Raises:
        ConfigError: it is none.
    """
    try:
        content = json.loads(path.read_text())
        return Record(**{**content, "rows": [Row(**row) for row in content["rows"]]})
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise ConfigError(f"{path}: expected a record of make planbench, found {brief(error)}") from None


def of_reference() -> list[Record]:
    """The published records, by task and number of robots.

    Raises:
        ConfigError: there is none.
    """
    found = [read(path) for path in FOLDER.glob("*.json")]
    if not found:
        raise ConfigError(f"reference: expected records in {FOLDER}, as a checkout of the repository has them")
    return sorted(found, key=lambda record: (record.task, record.robots))


def render(records: Sequence[Record], form: Format, console: Console) -> None:
    """Print records as tables, Markdown, CSV (an attempt a line) or JSON."""
    if form == "json":
        console.out(json.dumps([asdict(record) for record in records], indent=1), highlight=False)
    elif form == "csv":
        console.out(printing.csv_text(Attempt, _attempts(records)), end="", highlight=False)
    else:
        for sheet in [*([_overview(records)] if len(records) > 1 else []), *map(_sheet, records)]:
            if form == "table":
                console.print(printing.table(*sheet))
            else:
                console.out(printing.markdown(*sheet), highlight=False)


@dataclass(frozen=True)
class Attempt:
    """One method at one scene."""

    task: str
    robots: int
    scene: int
    method: str
    solved: bool
    seconds: float


def _attempts(records: Sequence[Record]) -> list[Attempt]:
    return [
        Attempt(record.task, record.robots, scene, row.method, solved, seconds)
        for record in records
        for row in record.rows
        for scene, (solved, seconds) in enumerate(zip(row.passed, row.seconds, strict=True))
    ]


def _overview(records: Sequence[Record]) -> Sheet:
    """Every record in a column: who solved how many scenes, and how soon on average."""
    by_kind = [_by_kind(record.rows) for record in records]
    kinds = dict.fromkeys(kind for own in by_kind for kind in own)
    rows = []
    for kind in sorted(kinds, key=lambda kind: kind.startswith("ORCA")):
        own = [of_record.get(kind) for of_record in by_kind]
        rows.append([kind, *(_of_networks(of_kind) if of_kind else "" for of_kind in own)])
    others = [
        "\n".join(
            f"{other.system.partition(' (')[0]} {other.solved}/{other.scenes}, {other.seconds:g} s"
            for other in peers.PUBLISHED.get((record.task, record.robots), [])
        )
        for record in records
    ]
    title = f"Scenes: solved, and mean time over all attempts, on {records[0].hardware}"
    header = ["", *(f"{record.task}, {record.robots}" for record in records)]
    return title, header, [*rows, ["published, on one large GPU", *others]]


def _by_kind(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by method without seed: those of networks that differ in nothing else."""
    kinds: dict[str, list[Row]] = {}
    for row in rows:
        kinds.setdefault(re.sub(r"-s\d+(?=, )", "", row.method), []).append(row)
    return kinds


def _of_networks(rows: Sequence[Row]) -> str:
    """The attempts of networks of one kind together."""
    return f"{_solved(rows)}\n{mean(one for row in rows for one in row.seconds):.3f} s"


def _solved(rows: Sequence[Row]) -> str:
    """How many attempts solved their scene, and the interval of their share.

    All networks were asked the same scenes, so the interval is that of one network's number of scenes.
    """
    solved, attempts, scenes = sum(row.solved for row in rows), sum(row.scenes for row in rows), rows[0].scenes
    low, high = wilson(round(solved * scenes / attempts), scenes)
    return f"{solved}/{attempts} [{low:.3f}, {high:.3f}]"


def _sheet(record: Record) -> Sheet:
    """One record, beside what others publish."""
    settings = record.settings
    title = f"{record.task}, {record.robots} robots: {settings['num']:g} candidates at a time, {settings['limit']:g} s"
    rows = [_cells(row) for row in record.rows]
    for other in peers.PUBLISHED.get((record.task, record.robots), []):
        numbers = [f"{other.solved}/{other.scenes}", f"{other.seconds:g}", *[""] * (len(HEADINGS) - 3)]
        rows.append([f"published: {other.system}, {other.hardware}", *numbers])
    if record.task in CROWDS and not any(row.method.startswith("ORCA") for row in record.rows):
        rows.append(["ORCA: not installed, pip install '.[planbench]'", *[""] * (len(HEADINGS) - 1)])
    return title, list(HEADINGS), rows


def _cells(row: Row) -> list[str]:
    def share(count: int, total: int) -> str:
        return f"{count}/{total}" if total else ""

    def number(value: float | None, digits: int = 3) -> str:
        return "" if value is None else f"{value:.{digits}f}"

    distance = ""
    if row.energy_distance:
        value, low, high = (f"{one:.3f}" for one in row.energy_distance)
        distance = f"{value} [{low}, {high}]"
    return [
        row.method,
        _solved([row]),
        *(f"{of(row.seconds):.3f}" for of in (mean, median, max)),
        share(row.raw_feasible, row.raw),
        share(row.guided_feasible, row.guided),
        number(row.conflicts, 1),
        number(row.path_length),
        number(row.smoothness, 4),
        number(row.adherence),
        distance,
    ]
