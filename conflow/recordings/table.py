"""A file of tracked positions as a table: which column is which, in which unit, at how many frames per second."""

import math
import re
from array import array
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from conflow.errors import ConfigError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# How files name the four columns, in small letters and without what is no letter.
_AGENTS = ("person", "pers", "ped", "pedestrian", "agent", "track", "robot", "object")
_NAMES = {
    "id": {"id", *_AGENTS, *(f"{agent}id" for agent in _AGENTS)},
    "frame": {"frame", "fr", "frameid", "framenumber", "frameno", "framenr", "frameindex"},
    "x": {"x", "xpos", "posx", "xposition", "positionx"},
    "y": {"y", "ypos", "posy", "yposition", "positiony"},
}
_UNIT = r"(mm|cm|m|millimet(?:er|re)s?|centimet(?:er|re)s?|met(?:er|re)s?)\b"
_METRES = {"mm": 0.001, "mi": 0.001, "cm": 0.01, "ce": 0.01, "m": 1.0, "me": 1.0}
_NO_POSITION = {"", "na", "n/a", "none", "null"}  # float takes nan itself


class Table(NamedTuple):
    """A file's rows: id and frame (rows,), x (rows, 2) in metres; the frame rate it states, and how it was read."""

    id: IntArray
    frame: IntArray
    x: FloatArray
    fps: float | None
    says: str


class _Layout(NamedTuple):
    """Where the columns id, frame, x, y are and who says so; nobody does where only guessing is left."""

    columns: tuple[int, ...]
    source: str


def read_table(path: Path) -> Table:
    """The rows of a file.

    Raises:
        ConfigError: there is no such file, or a line of it is no row.
    """
    if not path.is_file():  # of a pipe, reading would never end
        raise ConfigError(f"from={path}: no such file, expected a table of tracks")
    try:
        # Comments may be in any encoding, numbers are the same in most.
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            lines = enumerate(file, start=1)
            comments, header, first = _head(lines)
            if first is None:
                raise ConfigError(f"from={path}: holds no rows, expected columns id, frame, x and y")
            separator = _separator(first[1])
            layout = _layout(path, comments, header, len(first[1].strip().split(separator)))
            values = _values(path, chain([first], lines), separator, layout.columns)
    except OSError as error:
        raise ConfigError(f"from={path}: {error.strerror}, expected a file that can be read") from None
    return _understood(path, values, layout, "\n".join(comments), header or "")


def _head(lines: Iterator[tuple[int, str]]) -> tuple[list[str], str | None, tuple[int, str] | None]:
    """The comments and the header before the first row, and that row with its number."""
    comments: list[str] = []
    header = None
    for number, line in lines:
        if line.lstrip().startswith("#"):
            comments.append(line.strip().lstrip("# \t"))
        elif header is None and line.strip() and not _is_number(line.strip().split(_separator(line))[0]):
            header = line.strip()
        elif line.strip():
            return comments, header, (number, line)
    return comments, header, None


def _is_number(cell: str) -> bool:
    try:
        float(cell.strip().strip('"'))
    except ValueError:
        return False
    return True


def _separator(line: str) -> str | None:
    """What separates the cells of a line; None for blanks."""
    return next((mark for mark in ";,\t" if mark in line.strip()), None)


def _layout(path: Path, comments: Iterable[str], header: str | None, width: int) -> _Layout:
    """Which columns a file of `width` columns has where."""
    if header is not None:
        found = _named(header)
        for role in _NAMES:
            if len(found[role]) != 1:
                raise ConfigError(
                    f"from={path}: the header {header!a:.80} names {len(found[role])} columns for {role}, "
                    "expected one, as in id,frame,x,y"
                )
        return _Layout(tuple(found[role][0] for role in _NAMES), "as the header says")
    for comment in comments:
        columns = _commented(comment.rpartition(":")[2], width)
        if columns:
            return _Layout(columns, "as a comment says")
    if width < 4:
        raise ConfigError(f"from={path}: the first row has {width} columns, expected id, frame, x and y")
    return _Layout((0, 1, 2, 3, 4) if width == 8 else (0, 1, 2, 3), "")


def _named(header: str) -> dict[str, list[int]]:
    """The positions of the columns that a header names id, frame, x and y."""
    header = re.sub(r"\[.*?\]|\(.*?\)", "", header)  # units
    names = [re.sub(r"/.*|_[cm]?m$", "", cell.strip().strip('"').lower()) for cell in header.split(_separator(header))]
    letters = [re.sub(r"[^a-z]", "", name) for name in names]
    return {role: [i for i, name in enumerate(letters) if name in known] for role, known in _NAMES.items()}


def _commented(comment: str, width: int) -> tuple[int, ...] | None:
    """The columns where a comment is a header: it begins with id and frame, or names as many columns as there are."""
    found = _named(comment)
    if len(found["id"]) != 1 or len(found["frame"]) != 1:
        return None
    of_id, of_frame = found["id"][0], found["frame"][0]
    x, y = found["x"], found["y"]
    if {of_id, of_frame} == {0, 1} and not x and not y:
        return of_id, of_frame, 2, 3
    complete = {of_id, of_frame} == {0, 1} or len(comment.split(_separator(comment))) == width
    return (of_id, of_frame, x[0], y[0]) if complete and len(x) == len(y) == 1 else None


def _values(
    path: Path, lines: Iterable[tuple[int, str]], separator: str | None, columns: tuple[int, ...]
) -> FloatArray:
    """The numbers in the columns, and the number of the line, (rows, columns + 1)."""
    values = array("d")  # boxed numbers of a million rows would take ten times the memory
    for number, line in lines:
        if line.startswith("#"):
            continue
        cells = line.split(separator)
        try:
            values.fromlist([float(cells[i]) for i in columns])
        except (ValueError, IndexError):
            text = line.strip()
            if not text or text.startswith("#"):
                continue
            values.fromlist(_incomplete(path, number, text, cells, columns))
        values.append(number)
    return np.frombuffer(values).reshape(-1, len(columns) + 1)


def _incomplete(path: Path, number: int, text: str, cells: list[str], columns: tuple[int, ...]) -> list[float]:
    """The numbers of a row that does not consist of numbers alone, NaN where it holds no position."""
    try:
        wanted = [cells[i].strip().strip('"') for i in columns]
        return [
            math.nan if k > 1 and cell.lower() in _NO_POSITION else float(cell)  # but an id and a frame it must have
            for k, cell in enumerate(wanted)
        ]
    except (ValueError, IndexError):
        places = " and ".join(str(i + 1) for i in columns[:4])
        raise ConfigError(f"from={path}: line {number} is {text!a:.60}, expected numbers in columns {places}") from None


def _understood(path: Path, values: FloatArray, layout: _Layout, comments: str, header: str) -> Table:
    """The table that the numbers mean: which column is which, in which unit."""
    a, b = (_whole(path, values, k) for k in (0, 1))
    obsmat = values.shape[1] == 6 and bool((values[:, 3] == values[0, 3]).all())
    x = values[:, [2, 4] if obsmat else [2, 3]]
    unit, factor = _unit(comments, header)
    x = x * factor
    says = layout.source
    if not says:
        forward, backward = _stride(a, b, x), _stride(b, a, x)
        if backward < forward:
            a, b = b, a
        says = _guess(backward < forward, obsmat, min(forward, backward), max(forward, backward))
    elif layout.columns:
        order = sorted(zip(layout.columns, _NAMES, strict=False))
        says = f"columns {', '.join(name for _, name in order)}, {says}"
    return Table(a, b, x, _stated_fps(comments), f"{says}; {unit}")


def _whole(path: Path, values: FloatArray, k: int) -> IntArray:
    """Column k, which holds ids or frames."""
    wrong = ~(np.abs(values[:, k]) < 2**62) | (values[:, k] != np.floor(values[:, k]))
    if wrong.any():
        row = values[wrong.argmax()]
        raise ConfigError(f"from={path}: line {row[-1]:.0f} has {row[k]:g} for id or frame, expected a whole number")
    return values[:, k].astype(np.int64)


def _stride(track: IntArray, frame: IntArray, x: FloatArray) -> float:
    """The mean distance between neighbours along tracks; infinite where no track has two rows."""
    order = np.lexsort((frame, track))
    same = np.diff(track[order]) == 0
    steps = np.linalg.norm(np.diff(x[order], axis=0), axis=1)[same]
    steps = steps[np.isfinite(steps)]
    return float(steps.mean()) if len(steps) else math.inf


def _guess(frame_first: bool, obsmat: bool, taken: float, other: float) -> str:
    names = ("frame", "id") if frame_first else ("id", "frame")
    columns = ", ".join((*names, "x", "z", "y") if obsmat else (*names, "x", "y"))
    return (
        f"columns {columns} by a guess, since so neighbours along a track are {taken:.2g} m apart on average, "
        f"and the other way round {other:.2g} m"
    )


def _unit(comments: str, header: str) -> tuple[str, float]:
    """The unit of positions, in words and in metres."""
    text = f"{comments}\n{header}".lower()
    of_axis = re.search(rf"(?<![a-z])[xy]\s*(?:/|\[|\(|_|in\s)\s*\[?{_UNIT}", text)
    found = of_axis or re.search(rf"\bin\s+\[?{_UNIT}", text)
    if found is None:
        return "positions in m, since nothing else is said", 1.0
    factor = _METRES[found[1][:2]]
    return f"positions in {'m' if factor == 1 else 'cm' if factor == 0.01 else 'mm'}, as the file says", factor


def _stated_fps(comments: str) -> float | None:
    number = r"(\d+(?:\.\d+)?)"
    text = comments.lower()
    found = re.search(rf"{number}\s*(?:fps|hz|frames per)", text)
    found = found or re.search(rf"(?:frame[ _-]?rate|fps)[^0-9\n]{{0,20}}{number}", text)
    return float(found[1]) if found else None


def frame_rate(path: str | Path, stated: float | None, given: float | None) -> float:
    """Frames per second.

    Raises:
        ConfigError: nobody says them, or file and setting say different ones.
    """
    if given is None and not stated:
        raise ConfigError(f"fps: {path} has no comment such as '# framerate: 25', expected the frames per second")
    if given is not None and stated and not math.isclose(given, stated, rel_tol=1e-3):
        raise ConfigError(f"fps={given:g}: {path} says {stated:g}, expected the same, or none")
    return float(given or stated or 0)
