"""`make bench`: measure how fast everything is, beside what a user would take instead. format=table reference=0."""

import sys

from conflow import commandline
from conflow.__main__ import console, guarded
from conflow.results import printing
from tests.bench import suite, table


def bench(arguments: list[str]) -> None:
    """Measure and print, or with reference=1 print what is of record."""
    options, _ = commandline.options(arguments, {"format": "table", "reference": "0"}, settings=False)
    of_record = bool(commandline.whole(options, "reference", 0, 1))
    form = printing.checked_format(options["format"])
    path = suite.REFERENCE if of_record else suite.measure(console())
    table.render(suite.Bench.read(path), form, console())
    print(f"{'Read from' if of_record else 'Written'}: {path}", file=sys.stderr)


if __name__ == "__main__":
    guarded(bench, sys.argv[1:])
