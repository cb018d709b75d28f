"""Tables of results: of one run, and the comparison of many as a table, Markdown, CSV or JSON."""

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from typing import Any, Literal, cast, get_args

from rich.console import Console
from rich.table import Table

from conflow.experiment.compare import COLLISIONS, GUARDS, METHODS, QUALITIES, READINGS, SMOOTHNESS, Cell, Comparison
from conflow.experiment.config import ConfigError
from conflow.experiment.evaluation import Metrics
from conflow.experiment.module import Setting

AGAIN = "again with"
Format = Literal["table", "markdown", "csv", "json"]
Sheet = tuple[str, list[str], list[list[str]]]
"""Title, header and rows of a table, as text."""

ROWS = {
    "robot_collision_rate": "robot-collision rate",
    "object_collision_rate": "object-collision rate",
    "success_rate": "success rate",
    "outside_rate": "rate of leaving the workspace",
    "energy_distance": "energy distance to held-out D+",
    "smoothness_median": "smoothness, median",
    "smoothness_p95": "smoothness, 95th percentile",
    "path_length_median": "path length per robot, median",
    "start_error": "start error per robot",
    "end_error": "end error per robot",
    "diversity": "diversity",
}


def results_table(results: dict[Setting, Metrics], title: str) -> Table:
    """The test metrics of one run, a column for each setting, each with its 95 % interval."""
    num = int(next(iter(results.values()))["num"])
    made = Table(title=title, caption=f"{num} trajectories a setting; in brackets 95 % intervals")
    made.add_column("metric")
    for setting in results:
        made.add_column(setting, justify="right")
    for key, label in ROWS.items():
        made.add_row(label, *(_estimate(metrics, key) for metrics in results.values()))
    made.add_row("ms for a batch of 256", *(f"{metrics['latency_ms']:.0f}" for metrics in results.values()))
    return made


def _estimate(metrics: Metrics, key: str) -> str:
    """The value over its interval; nothing where the metric was left out."""
    if key not in metrics:
        return ""
    stem = key.removesuffix("_rate")
    return f"{metrics[key]:.4f}\n[dim]\\[{metrics[f'{stem}_low']:.4f}, {metrics[f'{stem}_high']:.4f}][/dim]"


def checked_format(name: str) -> Format:
    """The format of this name.

    Raises:
        ConfigError: there is none.
    """
    for known in get_args(Format):
        if name == known:
            return cast(Format, known)
    raise ConfigError(f"format={name}: expected one of {', '.join(get_args(Format))}")


def render(comparisons: Sequence[Comparison], form: Format, console: Console) -> None:
    """Print comparisons as tables, Markdown, CSV (the cells) or JSON (everything)."""
    if form == "json":
        console.out(json.dumps(_tree(comparisons), indent=1), highlight=False)
    elif form == "csv":
        cells = [cell for one in comparisons for cell in one.cells]
        console.out(csv_text(Cell, cells), end="", highlight=False)
    else:
        for one in comparisons:
            _print_sheets(_sheets(one), form, console)
            console.out(f"Unless a row says otherwise, at preset {one.preset}: {one.reading}\n", highlight=False)
        if len(comparisons) > 1:
            _print_sheets([_overview(comparisons)], form, console)


def _print_sheets(sheets: Iterable[Sheet], form: Format, console: Console) -> None:
    for title, header, rows in sheets:
        if form == "markdown":
            console.out(markdown(title, header, rows), highlight=False)
        else:
            console.print(table(title, header, rows))


def _tree(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """A comparison as it is; of several all cells together, which name their preset, and the rest by preset."""
    trees = [asdict(one) for one in comparisons]
    if len(trees) == 1:
        return trees[0]
    return {"cells": [cell for tree in trees for cell in tree.pop("cells")]} | {
        "presets": {tree.pop("preset"): tree for tree in trees}
    }


def csv_text(kind: Any, rows: Iterable[Any]) -> str:
    """Dataclasses of a kind as CSV, a line each under the names of the fields."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(kind)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()


def _overview(comparisons: Sequence[Comparison]) -> Sheet:
    """The first column of Table 1 at every preset that has one."""
    none = next(iter(COLLISIONS.values()))
    cells = {
        (cell.row, one.preset): cell
        for one in comparisons
        for cell in one.cells
        if (cell.table, cell.column) == ("1", none) and cell.row in METHODS.values()
    }
    presets = list(dict.fromkeys(preset for _, preset in cells))
    rows = []
    for method in METHODS.values():
        of_row = [cells.get((method, preset)) for preset in presets]
        if any(of_row):
            paper = next((f"{cell.paper:.4g}" for cell in of_row if cell and cell.paper is not None), "")
            rows.append([method, paper, *(_rate(cell) if cell else "" for cell in of_row)])
    return "Robot collisions without guidance, at each preset", ["", "paper", *presets], rows


def _rate(cell: Cell) -> str:
    return f"{cell.value:.4f} [{cell.low:.4f}, {cell.high:.4f}]\n{cell.count} of {cell.trajectories}, {_seeds(cell)}"


def _size(cell: Cell) -> str:
    return f"{cell.preset}, {_seeds(cell)}, {cell.trajectories} trajectories"


def _seeds(cell: Cell) -> str:
    return f"{cell.seeds} seed{'s' if cell.seeds > 1 else ''}"


def _sheets(comparison: Comparison) -> list[Sheet]:
    """Title, header and rows of the tables and of the claims, as text."""
    tables = {
        "1": ("Table 1: collision rates (setting: what is hit)", COLLISIONS),
        "2": ("Table 2: sources, without guidance", QUALITIES | SMOOTHNESS),
        "3": ("Table 3: quality without guidance", GUARDS),
        "4": ("Table 4: what the paper leaves open, changed one at a time", READINGS),
    }
    sheets = []
    for number, (title, metrics) in tables.items():
        cells = {(cell.row, cell.column): cell for cell in comparison.cells if cell.table == number}
        columns = _ordered((column for _, column in cells), metrics.values())
        rows = []
        for row in _ordered((row for row, _ in cells), metrics.values()):
            of_row = [cells.get((row, column)) for column in columns]
            texts = [_text(cell) if cell else "" for cell in of_row]
            if number == "2":  # whose columns are the methods
                rows.append([row, *texts])
            else:
                known = next(cell for cell in of_row if cell is not None)
                rows.append([f"{row}\n{_size(known)}", *texts, comparison.commands.get(row, "")])
        header = ["", *columns, AGAIN]
        if number == "2":
            rows.append([AGAIN, *(comparison.commands.get(column, "") for column in columns)])
            sizes = {column: _size(cell) for (_, column), cell in cells.items()}
            header = ["", *(f"{column}\n{sizes[column]}" for column in columns)]
        if cells:
            sheets.append((title, header, rows))
    if comparison.claims:
        claims = [[one.text, one.verdict, _p(one.p), _p(one.seeds_p), one.detail] for one in comparison.claims]
        header = ["claim", "verdict", "exact test on the counts", "t test between seeds", "values"]
        sheets.append(("Claims, the paper's first", header, claims))
    if comparison.reasons:
        differing = [list(pair) for pair in comparison.reasons.items()]
        sheets.append(("Where Table 1 differs from the paper's", ["row", "the most likely reason"], differing))
    return [(f"{title}, preset {comparison.preset}", header, rows) for title, header, rows in sheets]


def _p(p: float | None) -> str:
    if p is None:
        return ""
    return f"p = {p:.2g}" if p > 0 else "p < 1e-300"


def _ordered(names: Iterable[str], metrics: Iterable[str]) -> list[str]:
    """Each name once, metrics in their order even where the first of the runs lacks one."""
    rank = {metric: i for i, metric in enumerate(metrics)}
    return sorted(dict.fromkeys(names), key=lambda name: rank.get(name, 0))


def _text(cell: Cell) -> str:
    parts = [f"{cell.value:.4f}"]
    if cell.low is not None:
        parts[0] += f" [{cell.low:.4f}, {cell.high:.4f}]"
    if cell.count is not None:
        parts.append(f"{cell.count} of {cell.trajectories}")
    if cell.seeds > 1:
        parts.append(f"seeds {cell.seed_low:.4f} to {cell.seed_high:.4f}")
    if cell.paper is not None:
        agrees = "" if cell.paper_p is None else ", differs" if cell.differs else ", not distinguishable"
        parts.append(f"paper {cell.paper:.4g}{agrees}")
    return "\n".join(parts)


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table for the terminal."""
    made = Table(title=title, show_lines=True)
    for name in header:
        made.add_column(name, overflow="fold")  # a command that is cut short is none
    for row in rows:
        made.add_row(*(text.replace("[", "\\[") for text in row))
    return made


def markdown(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    shown = [
        [f"`{text}`" if text.startswith("make ") else text.replace("\n", "<br>") for text in row]
        for row in (header, *rows)
    ]
    lines = ["| " + " | ".join(row) + " |" for row in shown]
    lines = [f"**{title}**", "", lines[0], "|" + "---|" * len(header), *lines[1:]]
    return "\n".join(lines) + "\n"
