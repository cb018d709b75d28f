"""Tables of results: of one run, and the comparison of many as a table, Markdown, CSV or JSON."""

import csv
import io
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any, Literal, cast, get_args

from rich.console import Console
from rich.table import Table

from conflow.errors import ConfigError
from conflow.results import paper
from conflow.results.claims import Claim
from conflow.results.comparison import Comparison
from conflow.results.tables import COLLISIONS, ELSEWHERE, GUARDS, METHODS, QUALITIES, READINGS, SMOOTHNESS, Cell
from conflow.training.config import PAPERS_TASK, SPLITS
from conflow.training.summary import digits

AGAIN = "again with"
HEADLINE = ("cgp", "no_negatives", "fm", "fm_mixed", "gaussian", "gp", "plus")
"""The ablations of the first table that people see."""
MOST_OTHERS = 6
"""Runs of other settings that are named; there may be hundreds."""
Format = Literal["table", "markdown", "csv", "json"]
Sheet = tuple[str, list[str], list[list[str]]]
"""Title, header and rows of a table, as text."""

NOTE = """\
In brackets 95 % intervals. Over several seeds they are of the method: they say where the mean of many more networks
lies, and take in by how much the seeds differ. "Within this network" they are of the one that was trained alone.
"Differs": the paper's rate is not one that a new network of this method would reach in 256 trajectories, at 5 %.
Claims are decided at 5 % by a t test between seeds, in pairs where they share seed and demonstrations; the corrected p
(Holm's) allows for all claims of a table. "Not seen" is a difference that these seeds are too few, or too far apart, to
show after that correction.
"""


def _estimate(value: float, low: float | None, high: float | None, where: str = "") -> str:
    """The value and, where there is one, its interval."""
    return digits(value) if low is None or high is None else f"{digits(value)}{where} [{digits(low)}, {digits(high)}]"


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
        for one in comparisons:  # beside the cells, of which this is none
            for line in (_where(one), *_reservations(one)):
                print(line, file=sys.stderr)
    else:
        for one in comparisons:
            _print_sheets(_sheets(one), form, console)
            console.out(f"Unless a row says otherwise, at {_place(one)}: {one.reading}\n", highlight=False)
            for line in _reservations(one):
                console.out(f"{line}\n", highlight=False)
        of_paper = [one for one in comparisons if one.task == PAPERS_TASK]
        if len(of_paper) > 1:
            _print_sheets([_overview(of_paper)], form, console)
        console.out(NOTE, highlight=False)


def _where(comparison: Comparison) -> str:
    return f"{_place(comparison)}, {SPLITS[comparison.split]} split"


def _place(comparison: Comparison) -> str:
    """The preset, behind the task where that is not the paper's."""
    of_task = "" if comparison.task == PAPERS_TASK else f"task {comparison.task}, "
    return f"{of_task}preset {comparison.preset}"


def _reservations(comparison: Comparison) -> list[str]:
    """What is missing, and which runs are not what the others are, or were measured elsewhere."""
    missing = _missing(comparison)
    found = [f"Of the paper's methods there is no finished run of {', '.join(missing)}"] if missing else []
    found += [comparison.code] if comparison.code else []
    if comparison.split != "test" and any(cell.without_model for cell in comparison.cells):
        found.append("Rows without a model are of the test split.")
    if comparison.left_out:
        runs = ", ".join(comparison.left_out)
        found.append(f"Not measured on the {SPLITS[comparison.split]} split, and left out: {runs}; try: split=test")
    if comparison.others:
        shown, more = ", ".join(comparison.others[:MOST_OTHERS]), len(comparison.others) - MOST_OTHERS
        rest = f" and {more} more" if more > 0 else ""
        found.append(f"Finished too, of other tasks, data or settings: {shown}{rest}. Compare them by their own ARGS")
    return found


def _missing(comparison: Comparison) -> list[str]:
    """The methods of the paper's tables that have no row, where others have one."""
    rows = {cell.row for cell in comparison.cells if cell.table == "1"}
    expected = [METHODS[ablation] for ablation in paper.TABLE_1 | paper.TABLE_2]
    of_paper = comparison.task == PAPERS_TASK and not rows.isdisjoint(expected)
    return [method for method in expected if of_paper and method not in rows]


def _print_sheets(sheets: Iterable[Sheet], form: Format, console: Console) -> None:
    for title, header, rows in sheets:
        if form == "markdown":
            console.out(markdown(title, header, rows), highlight=False)
        else:
            console.print(table(title, header, rows))


def _tree(comparisons: Sequence[Comparison]) -> dict[str, Any]:
    """A comparison as it is; of several all cells together, whose rows name what they are of, and the rest by that."""
    trees = [asdict(one) for one in comparisons]
    if len(trees) == 1:
        return trees[0]
    return {"cells": [cell for tree in trees for cell in tree.pop("cells")]} | {
        "presets": {_key(tree.pop("preset"), tree.pop("task")): tree for tree in trees}
    }


def _key(preset: str, task: str) -> str:
    return preset if task == PAPERS_TASK else f"{preset}, task={task}"


def csv_text(kind: Any, rows: Iterable[Any]) -> str:
    """Dataclasses of a kind as CSV, a line each under the names of the fields."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(kind)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()


def _overview(comparisons: Sequence[Comparison]) -> Sheet:
    """The first column of Table 1 at every preset that has one: the paper's methods and what is best beyond them.

    Of comparisons of the paper's task.
    """
    none = next(iter(COLLISIONS.values()))
    cells = {
        (cell.row, one.preset): cell
        for one in comparisons
        for cell in one.cells
        if (cell.table, cell.column) == ("1", none) and not cell.without_model
    }
    presets = list(dict.fromkeys(preset for _, preset in cells))
    rows = []
    for method in [METHODS[ablation] for ablation in HEADLINE]:
        of_row = [cells.get((method, preset)) for preset in presets]
        if any(of_row):
            printed = next((f"{cell.paper:.4g}" for cell in of_row if cell and cell.paper is not None), "")
            rows.append([method, printed, *(_rate(cell) if cell else "" for cell in of_row)])
    title = f"Robot collisions without guidance, at each preset, {SPLITS[comparisons[0].split]} split"
    return title, ["", "printed in the paper", *(f"preset {one}" for one in presets)], rows


def _rate(cell: Cell) -> str:
    return f"{_mean(cell)}\n{_count(cell)}, {_seeds(cell)}"


def _size(cell: Cell) -> str:
    size = f"{cell.preset}, {_seeds(cell)}, {cell.trajectories} trajectories"
    return size if cell.without_model else f"{size}\n{cell.machine}"


def _seeds(cell: Cell) -> str:
    return f"{cell.seeds} seed{'s' if cell.seeds > 1 else ''}"


def _sheets(comparison: Comparison) -> list[Sheet]:
    """The tables that have cells, the claims, and the reasons."""
    sheets = [
        _methods_down(comparison, "1", "Table 1: collision rates (setting: what is hit)", COLLISIONS),
        _methods_across(comparison, "2", "Table 2: sources, without guidance", QUALITIES | SMOOTHNESS),
        _methods_down(comparison, "3", "Table 3: quality without guidance", GUARDS),
        _methods_down(comparison, "4", "Table 4: what the paper leaves open, changed one at a time", READINGS),
        _methods_down(comparison, "5", "Table 5: other demonstrations", ELSEWHERE),
        (
            "Claims, the paper's first",
            ["claim", "verdict", "p", "corrected p", "values"],
            [[one.text, _verdict(one), _p(one.p), _p(one.corrected_p), one.detail] for one in comparison.claims],
        ),
        (
            "Where Table 1 differs from the paper's",
            ["row", "the most likely reason"],
            [[row, reason] for row, reason in comparison.reasons.items()],
        ),
    ]
    return [(f"{title}, {_where(comparison)}", header, rows) for title, header, rows in sheets if rows]


def _methods_down(comparison: Comparison, number: str, title: str, metrics: Mapping[str, str]) -> Sheet:
    """A table with a row for each method: its size, its numbers, and what makes it again."""
    cells = _cells(comparison, number)
    columns = _ordered((column for _, column in cells), metrics.values())
    rows = []
    for method in dict.fromkeys(row for row, _ in cells):
        of_method = [cells.get((method, column)) for column in columns]
        size = next(_size(cell) for cell in of_method if cell)
        texts = [_text(cell) if cell else "" for cell in of_method]
        rows.append([f"{method}\n{size}", *texts, comparison.commands.get(method, "")])
    return title, ["", *columns, AGAIN], rows


def _methods_across(comparison: Comparison, number: str, title: str, metrics: Mapping[str, str]) -> Sheet:
    """A table with a column for each method, under its size and over what makes it again."""
    cells = _cells(comparison, number)
    sizes = {method: _size(cell) for (_, method), cell in cells.items()}
    rows = []
    for metric in _ordered((row for row, _ in cells), metrics.values()):
        of_metric = [cells.get((metric, method)) for method in sizes]
        rows.append([metric, *(_text(cell) if cell else "" for cell in of_metric)])
    if rows:
        rows.append([AGAIN, *(comparison.commands.get(method, "") for method in sizes)])
    return title, ["", *(f"{method}\n{size}" for method, size in sizes.items())], rows


def _cells(comparison: Comparison, number: str) -> dict[tuple[str, str], Cell]:
    """A table's cells by row and column."""
    return {(cell.row, cell.column): cell for cell in comparison.cells if cell.table == number}


def _verdict(claim: Claim) -> str:
    unseen = "" if claim.unseen is None else f", differences below {claim.unseen:.2g} are not seen"
    return f"{claim.verdict}{unseen}"


def _p(p: float | None) -> str:
    return "" if p is None else f"{p:.2g}"


def _ordered(names: Iterable[str], metrics: Iterable[str]) -> list[str]:
    """Each name once, metrics in their order even where the first of the runs lacks one."""
    rank = {metric: i for i, metric in enumerate(metrics)}
    return sorted(dict.fromkeys(names), key=lambda name: rank.get(name, 0))


def _text(cell: Cell) -> str:
    seeds = f"seeds {digits(cell.seed_low)} to {digits(cell.seed_high)}" if cell.seeds > 1 else ""
    parts = [_mean(cell), ", ".join(part for part in (_count(cell), seeds) if part)]
    if cell.paper is not None:
        parts.append(f"paper {cell.paper:.4g}{_agreement(cell)}")
    return "\n".join(part for part in parts if part)


def _mean(cell: Cell) -> str:
    """The value and its interval, which of one seed says nothing of others."""
    where = ", within this network" if cell.low is None and cell.within_low is not None else ""
    return _estimate(cell.value, *cell.interval, where)


def _count(cell: Cell) -> str:
    return "" if cell.count is None else f"{cell.count} of {cell.trajectories}"


def _agreement(cell: Cell) -> str:
    """What is said of the paper's rate; other numbers of the paper are not judged."""
    if cell.differs is None:
        return ", one seed: not judged" if cell.table == "1" else ""
    return ", differs" if cell.differs else ", not distinguishable"


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
