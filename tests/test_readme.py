"""What README, FINDINGS and BENCH show is what the records under runs/reference/ say, and what they link to exists."""

import re
from pathlib import Path

import pytest
from rich.console import Console

from conflow.results import comparison, planbench, printing
from tests.bench import suite, table

ROOT = Path(__file__).parents[1]
REFERENCE = Path("runs/reference")
PAGES = [Path("README.md"), REFERENCE / "FINDINGS.md", REFERENCE / "BENCH.md"]
LENGTH, WIDTH = 200, 120
"""Lines of the README, and characters of a line outside tables."""
TITLED = re.compile(r"^\*\*.+\*\*\n\n(?:\|.*\n)+", re.MULTILINE)
"""A table in Markdown under its title."""
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


@pytest.fixture(autouse=True)
def root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)


def test_every_titled_table_is_printed_by_a_command() -> None:
    """Printed by: make compare REFERENCE=1 FORMAT=markdown, and likewise make bench and make planbench."""
    console = Console()
    with console.capture() as captured:
        printing.render(comparison.collect_reference(), "markdown", console)
        table.render(suite.Bench.read(suite.REFERENCE), "markdown", console)
        planbench.render(planbench.of_reference(), "markdown", console)
    printed = TITLED.findall(captured.get())
    shown = {page: TITLED.findall(page.read_text()) for page in PAGES}
    assert [one for tables in shown.values() for one in tables if one not in printed] == []
    readme, _, bench = PAGES
    assert len(shown[readme]) == 2
    assert len(shown[bench]) > 5


def test_the_tables_of_record_are_what_make_compare_prints() -> None:
    """Written by: make compare REFERENCE=1 FORMAT=markdown > runs/reference/TABLES.md."""
    console = Console()
    with console.capture() as captured:
        printing.render(comparison.collect_reference(), "markdown", console)
    assert (REFERENCE / "TABLES.md").read_text() == captured.get()


def test_the_scenes_of_record_are_what_make_planbench_prints() -> None:
    """Written by: make planbench REFERENCE=1 FORMAT=markdown > runs/reference/PLANBENCH.md."""
    console = Console()
    with console.capture() as captured:
        planbench.render(planbench.of_reference(), "markdown", console)
    assert (REFERENCE / "PLANBENCH.md").read_text() == captured.get()


def test_the_readme_is_one_page() -> None:
    lines = Path("README.md").read_text().splitlines()
    assert len(lines) <= LENGTH
    assert [line for line in lines if len(line) > WIDTH and not line.startswith("|")] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_and_picture_exists(page: Path) -> None:
    links = LINK.findall(page.read_text())
    assert links
    assert [link for link in links if not _exists(page, link)] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_nothing_is_left_to_fill_in(page: Path) -> None:
    assert re.findall(r"\{\{.*", page.read_text()) == []


def _exists(page: Path, link: str) -> bool:
    """Whether a link of a page leads to a file or folder here, and its fragment to a heading; the web is not asked."""
    if link.startswith("https://"):
        return True
    path, _, fragment = link.partition("#")
    target = page.parent / path if path else page
    return target.exists() and (not fragment or fragment in map(_anchor, HEADING.findall(target.read_text())))


def _anchor(heading: str) -> str:
    """As GitHub writes it."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")
