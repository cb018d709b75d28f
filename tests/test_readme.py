"""The numbers of the README and of TABLES.md are those of the records under runs/reference/."""

import re
from pathlib import Path

import pytest
from rich.console import Console

from conflow.bench import suite, table
from conflow.experiment import compare, report

ROOT = Path(__file__).parents[1]
TITLED = re.compile(r"^\*\*.+\*\*\n\n(?:\|.*\n)+", re.MULTILINE)
"""A table in Markdown under its title."""


@pytest.fixture(autouse=True)
def root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


def test_every_titled_table_is_printed_by_make_compare_or_make_bench() -> None:
    console = Console()
    with console.capture() as captured:
        report.render(compare.collect_reference(), "markdown", console)
        table.render(suite.Bench.read(suite.REFERENCE), "markdown", console)
    printed = TITLED.findall(captured.get())
    shown = TITLED.findall(Path("README.md").read_text())
    assert len(shown) > 10
    # Printed by: make compare REFERENCE=1 FORMAT=markdown, make bench REFERENCE=1 FORMAT=markdown.
    assert [one for one in shown if one not in printed] == []


def test_the_tables_of_record_are_what_make_compare_prints() -> None:
    """Written by: make compare REFERENCE=1 FORMAT=markdown > runs/reference/TABLES.md."""
    console = Console()
    with console.capture() as captured:
        report.render(compare.collect_reference(), "markdown", console)
    assert Path("runs/reference/TABLES.md").read_text() == captured.get()
