"""The bench as tables for the terminal or in Markdown."""

import json
from dataclasses import asdict

from rich.console import Console

from conflow.results.printing import Format, csv_text, markdown, table
from tests.bench.clock import Row
from tests.bench.suite import Bench

HEADER = ["what", "takes", "beside", "which takes", "ratio, median [quartiles]", "target"]


def render(bench: Bench, form: Format, console: Console) -> None:
    """Print a table for each part in Markdown or for the terminal, the lines as CSV, or everything as JSON."""
    if form == "json":
        console.out(json.dumps(asdict(bench), indent=1), highlight=False)
        return
    if form == "csv":
        console.out(csv_text(Row, bench.rows), end="", highlight=False)
        return
    said = bench.origin
    console.print(f"{said['hardware']}, {said['threads']} threads; {said['versions']}; {said['date']}", highlight=False)
    for part in dict.fromkeys(row.part for row in bench.rows):
        lines = [line(row) for row in bench.rows if row.part == part]
        if form == "markdown":
            console.out(markdown(part, HEADER, lines), highlight=False)
        else:
            console.print(table(part, HEADER, lines))


def line(row: Row) -> list[str]:
    """The cells of a row as text."""
    ours, theirs = (seconds(one) if one is not None else "" for one in (row.ours, row.theirs))
    return [row.what, ours, row.beside, theirs, "\n".join(filter(None, [_ratio(row), row.note])), _target(row)]


def seconds(value: float) -> str:
    """A time with three digits."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value / 1e-6:.3g} µs"


def _ratio(row: Row) -> str:
    if row.ratio is None or row.low is None or row.high is None:
        return ""
    words = {"share": "of it", "time": "times its time", "speed": "times as fast", "seconds": ""}
    forms = {"share": "{:.2%}", "time": "{:.3g}", "speed": "{:.3g}"}
    low, middle, high = (
        seconds(one) if row.kind == "seconds" else forms[row.kind].format(one) for one in (row.low, row.ratio, row.high)
    )
    spread = f"[{low}, {high}]" if row.low < row.high else ""  # of one measurement there is none
    ratio = "" if row.kind == "seconds" else f"{middle} {words[row.kind]}"  # which stands in the column before
    return " ".join(filter(None, [ratio, spread]))


def _target(row: Row) -> str:
    if row.target is None or row.ratio is None:
        return ""
    bound = f"{row.target.bound:.0%}" if row.kind == "share" else f"{row.target.bound:.3g}"
    wanted = f"{'at most' if row.target.at_most else 'at least'} {bound}"
    if row.target.met(row.ratio):
        return f"{wanted}: met"
    return f"{wanted}: missed, {row.ratio / row.target.bound:.2f} times that"
