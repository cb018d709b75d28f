"""Demonstrations from tracks of people or robots: windows in which some of them meet, in one common scale."""

import heapq
import math
import re
from array import array
from collections.abc import Iterable, Iterator
from itertools import chain, combinations, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from conflow.errors import ConfigError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

GAP = 0.5
"""Seconds: a track is filled linearly where at most this long nothing of it was seen, and split where longer."""

OPPOSITE = math.radians(135)
"""Two agents whose walking directions differ by more walk in opposite directions."""

STANDING = 0.05
"""Metres per second: who moves on average slower through a window stands, and has no walking direction."""

EXTENT = 0.95
"""The largest coordinate of all windows, in workspace units."""

QUANTILES = (0.1, 0.25, 0.5)
"""Shares of infeasible windows for which the summary names a radius."""

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
_CHUNK = 50_000  # rows in which neighbours are looked for at once: so many that numpy is fast, yet memory bounded


class Windows(NamedTuple):
    """Windows of `seconds` in which `agents` agents meet, as demonstrations in workspace units.

    x[n, t] = (position(t) - centre[n]) / scale for every agent, in the order of ids[n]. Plans for them come back in
    metres relative to an encounter's centre: scale * x + offset.
    """

    x: Tensor
    """(N, T, 2 agents), float32, as (x1, y1, x2, y2, ...): evenly spaced in time, within [-0.95, 0.95]."""

    scale: float
    """Metres per workspace unit."""

    offset: FloatArray
    """(2,), zeros: every window has a centre of its own, a file has none."""

    seconds: float
    """How long a window is."""

    centre: FloatArray
    """(N, 2), metres: the midpoint of the bounding box of all the window's positions."""

    ids: IntArray
    """(N, agents): whom the file calls so."""

    frame: FloatArray
    """(N,): the frame in the middle of the window: of the closest approach, or for a single agent any."""

    summary: str
    """What was read, left out and found, and what share of the windows which `constraint.radius` makes infeasible."""

    @property
    def dt(self) -> float:
        """Seconds between two waypoints, seconds / (T - 1)."""
        return self.seconds / (self.x.shape[1] - 1)


def read(
    path: str | Path,
    agents: int = 2,
    seconds: float = 6.0,
    T: int = 32,
    fps: float | None = None,
    opposite: bool = True,
    near: float = 2.0,
) -> Windows:
    """Windows in which agents meet, from a file of tracked positions.

    The file has a row for every agent and frame, separated by commas, semicolons, tabs or blanks. A header, or a
    comment such as `# id frame x/m y/m z/m`, names the columns id, frame, x and y, others are ignored. Without a
    header these four come first, in this order or as `frame id x y`: that one is taken in which neighbours along a
    track lie nearer to each other on average. Eight columns of which the fourth never changes are those of ETH's
    obsmat.txt, frame id x z y and velocities. Positions are in metres, or in cm or mm where a comment or the header
    says so. Comments such as `# framerate: 25.00` give the frames per second.

    Of repeated rows one counts. Rows that place an agent at two places in one frame count as not seen. A track is
    filled linearly where for at most GAP seconds, beyond the usual step between frames, it was not seen, and else
    split.

    Of every set of `agents` tracks the closest approach is the frame at which the largest distance between two of
    them is smallest. There the set must be within `near`, and a window of `seconds` with this frame in the middle must
    lie inside all of its tracks. Frames are looked at in the file's usual step. A single agent meets nobody: its
    track is cut into windows one after the other.

    The agents of a window are sorted by where they start along the main direction of travel in the file, taken as an
    undirected axis that points to the right, or up where it is steeper.

    Args:
        path: the file.
        agents: how many meet.
        seconds: length of a window.
        T: waypoints, the first and the last at the window's ends.
        fps: frame numbers per second, where the file does not say it. ETH's obsmat.txt has every sixth frame of 15 per
            second: 15. Its hotel, UCY and the files that Social-GAN distributes have every tenth of 25: 25.
        opposite: only sets of which two walk in opposite directions, by their displacements over the window.
        near: metres. Who never comes that close does not meet.

    Raises:
        ConfigError: a setting is out of range, the file cannot be read, or it has no such window.
    """
    _check(agents, seconds, T, fps, near)
    table = _table(Path(path))
    rate = _frame_rate(path, table.fps, fps)
    tracks, read_in = _tracks(path, table, rate)
    long = tracks.select(tracks.last - tracks.first >= seconds * rate - 1e-9)
    meetings = _cut(long, seconds * rate) if agents == 1 else _meetings(long, agents, near)
    found = _Found(len(tracks.ids), len(long.ids), len(meetings.frame))

    inside = _inside(long, meetings, seconds * rate)
    meetings = meetings.select(inside)
    positions = _positions(long, meetings, seconds * rate, T)
    walks = _opposite(positions, seconds) if opposite and agents > 1 else np.full(len(positions), True)
    meetings, positions = meetings.select(walks), positions[walks]
    found = found._replace(inside=int(inside.sum()), windows=len(positions))
    if not len(positions):
        longest = _longest(tracks, agents) / rate
        raise ConfigError(_nothing(found, agents, seconds, near, longest))

    order = _order(positions)
    positions = np.take_along_axis(positions, order[:, None, :, None], axis=2)
    ids = np.take_along_axis(long.ids[meetings.members], order, axis=1)
    centre = (positions.min(axis=(1, 2)) + positions.max(axis=(1, 2))) / 2
    centred = positions - centre[:, None, None]
    scale = float(np.abs(centred).max()) / EXTENT
    if scale == 0:
        raise ConfigError(
            f"from={path}: nobody moves in any of {len(positions)} windows, expected positions that change"
        )
    x = torch.from_numpy((centred / scale).astype(np.float32)).flatten(2)
    summary = f"{path}: {read_in} {_windows_found(found, agents, seconds, near, opposite)} {_sizes(x, scale)}"
    return Windows(x, scale, np.zeros(2), float(seconds), centre, ids, meetings.frame, summary)


def closest(x: Tensor) -> Tensor:
    """The smallest distance at waypoints between two of the agents of x (N, T, 2 agents), (N,); two agents or more.

    A window violates `constraint.radius` where this is smaller.
    """
    p = x.unflatten(2, (-1, 2))
    distances = [
        torch.linalg.vector_norm(p[:, :, a] - p[:, :, b], dim=2) for a, b in combinations(range(p.shape[2]), 2)
    ]
    return torch.stack(distances).amin(dim=(0, 2))


def _check(agents: int, seconds: float, T: int, fps: float | None, near: float) -> None:
    if agents < 1:
        raise ConfigError(f"agents={agents}: expected 1 or more")
    if T < 3:
        raise ConfigError(f"T={T}: expected 3 waypoints or more")
    for name, value in (("seconds", seconds), ("fps", 1.0 if fps is None else fps), ("near", near)):
        if not (0 < value < math.inf):
            raise ConfigError(f"{name}={value}: expected a positive number")


# Reading the file


class _Table(NamedTuple):
    """A file's rows: id and frame (rows,), x (rows, 2) in metres, with the frame rate that it states, if any."""

    id: IntArray
    frame: IntArray
    x: FloatArray
    fps: float | None
    says: str


class _Layout(NamedTuple):
    """Where the columns id, frame, x, y are and who says so; nobody does where only guessing is left."""

    columns: tuple[int, ...]
    source: str


def _table(path: Path) -> _Table:
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


def _understood(path: Path, values: FloatArray, layout: _Layout, comments: str, header: str) -> _Table:
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
    return _Table(a, b, x, _stated_fps(comments), f"{says}; {unit}")


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


def _frame_rate(path: str | Path, stated: float | None, given: float | None) -> float:
    """Frames per second.

    Raises:
        ConfigError: nobody says them, or file and setting say different ones.
    """
    if given is None and not stated:
        raise ConfigError(f"fps: {path} has no comment such as '# framerate: 25', expected the frames per second")
    if given is not None and stated and not math.isclose(given, stated, rel_tol=1e-3):
        raise ConfigError(f"fps={given:g}: {path} says {stated:g}, expected the same, or none")
    return float(given or stated or 0)


# Tracks


class _Tracks:
    """Tracks one after the other: rows (frame, x) in order of time, of which track k begins with row start[k]."""

    def __init__(self, frame: IntArray, x: FloatArray, start: IntArray, ids: IntArray, step: int) -> None:
        self.frame, self.x, self.start, self.ids, self.step = frame, x, start, ids, step
        self.size = np.diff(start, append=len(frame))
        self.first, self.last = frame[start], frame[start + self.size - 1]
        # On one axis all tracks follow each other, each with its own frames: one interpolation serves all.
        self.shift = np.concatenate([[0], np.cumsum(self.last - self.first + 1)])[:-1] - self.first
        self.axis = (frame + np.repeat(self.shift, self.size)).astype(np.float64)

    def at(self, track: IntArray, frame: FloatArray) -> FloatArray:
        """Positions of tracks at frames within them, (..., 2), linear between rows."""
        if not len(self.frame):
            return np.empty((*np.broadcast_shapes(np.shape(track), np.shape(frame)), 2))
        where = frame + self.shift[track]
        return np.stack([np.interp(where, self.axis, self.x[:, k]) for k in (0, 1)], axis=-1)

    def select(self, which: BoolArray) -> "_Tracks":
        """The tracks of a mask."""
        rows = np.repeat(which, self.size)
        start = np.cumsum(self.size[which]) - self.size[which]
        return _Tracks(self.frame[rows], self.x[rows], start, self.ids[which], self.step)


def _tracks(path: str | Path, table: _Table, fps: float) -> tuple[_Tracks, str]:
    """The tracks of a table, and how they came about.

    Raises:
        ConfigError: no row can be used.
    """
    seen = np.isfinite(table.x).all(axis=1)
    ids, frame, x = table.id[seen], table.frame[seen], table.x[seen]
    order = np.lexsort((x[:, 1], x[:, 0], frame, ids))
    ids, frame, x = ids[order], frame[order], x[order]
    again = np.concatenate([[False], (np.diff(ids) == 0) & (np.diff(frame) == 0)])[: len(ids)]
    repeated = again & np.concatenate([[False], (np.diff(x, axis=0) == 0).all(axis=1)])[: len(ids)]
    ids, frame, x, again = ids[~repeated], frame[~repeated], x[~repeated], again[~repeated]
    contradicts = again | np.append(again[1:], False)[: len(ids)]
    ids, frame, x = ids[~contradicts], frame[~contradicts], x[~contradicts]
    left_out = _listed(
        (int(repeated.sum()), "repeated rows"),
        (int(contradicts.sum()), "rows that put an agent at two places in one frame"),
        (int((~seen).sum()), "rows without a position"),
    )
    if not len(ids):
        raise ConfigError(f"from={path}: has {left_out}, expected some others; {table.says}")

    same, distance = np.diff(ids) == 0, np.diff(frame)
    step = int(np.median(distance[same])) if same.any() else 1
    gap = same & (distance - step > GAP * fps + 1e-9)
    filled = same & ~gap & (distance >= 2 * step)
    start = np.flatnonzero(np.concatenate([[True], ~same | gap]))
    read_in = (
        f"{seen.size} rows, {table.says}; {fps:g} frames per second, in steps of {step}. Left out: "
        f"{left_out}. {len(np.unique(ids))} ids make {len(start)} tracks, with {int(filled.sum())} gaps of up to "
        f"{GAP:g} s filled and {int(gap.sum())} longer ones split."
    )
    return _Tracks(frame, x, start, ids[start], step), read_in


def _listed(*counts: tuple[int, str]) -> str:
    return ", ".join(f"{count} {what}" for count, what in counts if count) or "nothing"


# Windows


class _Meetings(NamedTuple):
    """Sets of tracks, members (sets, agents), and the frame in which each set meets, (sets,)."""

    members: IntArray
    frame: FloatArray

    def select(self, which: BoolArray) -> "_Meetings":
        return _Meetings(self.members[which], self.frame[which])


class _Found(NamedTuple):
    """How many were left at each step."""

    tracks: int
    long: int
    sets: int
    inside: int = 0
    windows: int = 0


def _cut(tracks: _Tracks, width: float) -> _Meetings:
    """Windows of single tracks, `width` frames long, one after the other."""
    count = np.floor((tracks.last - tracks.first) / width + 1e-9).astype(np.int64)
    track = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(track)) - np.repeat(np.cumsum(count) - count, count)
    return _Meetings(track[:, None], tracks.first[track] + (number + 0.5) * width)


def _meetings(tracks: _Tracks, agents: int, near: float) -> _Meetings:
    """The closest approach of every set of tracks that comes within `near`."""
    track, frame = _grid(tracks)
    x = tracks.at(track, frame.astype(np.float64))
    # Chunks of whole frames: a set is complete within one frame.
    begin = np.flatnonzero(np.diff(frame, prepend=frame[:1] - 1))
    begin = begin[np.diff(begin // _CHUNK, prepend=-1) > 0]
    best = [(np.empty((0, agents), np.int64), np.empty(0), np.empty(0, np.int64))]
    for low, high in pairwise([*begin, len(frame)]):
        rows, distance = _together(x[low:high], frame[low:high], agents, near)
        best.append(_nearest(track[low:high][rows], distance, frame[low:high][rows[:, 0]]))
    members, _, when = _nearest(*(np.concatenate(parts) for parts in zip(*best, strict=True)))
    return _Meetings(members, when.astype(np.float64))


def _grid(tracks: _Tracks) -> tuple[IntArray, IntArray]:
    """Every track at every frame of a grid with the file's usual step: (track, frame), in order of frame and track."""
    if not len(tracks.ids):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    phases, counts = np.unique(tracks.frame % tracks.step, return_counts=True)
    phase = phases[counts.argmax()]  # that of most rows, where nothing is interpolated
    low, high = -((phase - tracks.first) // tracks.step), (tracks.last - phase) // tracks.step
    count = np.maximum(high - low + 1, 0)
    track = np.repeat(np.arange(len(count)), count)
    number = np.arange(len(track)) - np.repeat(np.cumsum(count) - count, count)
    frame = (low[track] + number) * tracks.step + phase
    order = np.argsort(frame, kind="stable")
    return track[order], frame[order]


def _together(x: FloatArray, frame: IntArray, agents: int, near: float) -> tuple[IntArray, FloatArray]:
    """Sets of rows of one frame of which each is within `near` of each, with their largest distance.

    Sets grow by one row after the other, from pairs of neighbours.
    """
    # A third coordinate sets frames apart, so that one tree serves all of them.
    height = np.searchsorted(np.unique(frame), frame) * (2 * near)
    pairs = cKDTree(np.column_stack([x, height])).query_pairs(near, output_type="ndarray").astype(np.int64)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    partners = np.bincount(pairs[:, 0], minlength=len(x))
    begin = np.cumsum(partners) - partners
    sets, distance = pairs, np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    for _ in range(agents - 2):
        count = partners[sets[:, -1]]
        old = np.repeat(np.arange(len(sets)), count)
        number = np.arange(len(old)) - np.repeat(np.cumsum(count) - count, count)
        new = pairs[begin[sets[old, -1]] + number, 1]
        apart = np.linalg.norm(x[sets[old]] - x[new][:, None], axis=2).max(axis=1)
        keep = apart <= near
        sets = np.column_stack([sets[old], new])[keep]
        distance = np.maximum(distance[old], apart)[keep]
    return sets, distance


def _nearest(members: IntArray, distance: FloatArray, frame: IntArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Of each set the smallest distance and its frame, the first of several."""
    order = np.lexsort((frame, distance, *members.T[::-1]))
    members, distance, frame = members[order], distance[order], frame[order]
    new = np.concatenate([[True], np.any(members[1:] != members[:-1], axis=1)])[: len(members)]
    return members[new], distance[new], frame[new]


def _inside(tracks: _Tracks, meetings: _Meetings, width: float) -> BoolArray:
    """Whether the window of `width` frames lies inside all of a set's tracks, (sets,)."""
    first, last = tracks.first[meetings.members].max(axis=1), tracks.last[meetings.members].min(axis=1)
    return (meetings.frame - width / 2 >= first - 1e-6) & (meetings.frame + width / 2 <= last + 1e-6)


def _positions(tracks: _Tracks, meetings: _Meetings, width: float, T: int) -> FloatArray:
    """The windows' positions in metres, (sets, T, agents, 2)."""
    if not len(meetings.frame):
        return np.empty((0, T, meetings.members.shape[1], 2))
    times = meetings.frame[:, None] + width * np.linspace(-0.5, 0.5, T)
    return tracks.at(meetings.members[:, None, :], times[:, :, None])


def _opposite(positions: FloatArray, seconds: float) -> BoolArray:
    """Whether two agents walk in opposite directions, (sets,)."""
    travel = positions[:, -1] - positions[:, 0]
    length = np.linalg.norm(travel, axis=2)
    direction = travel / np.maximum(length, STANDING * seconds)[..., None]  # who stands has no unit vector
    cosine = np.einsum("sad,sbd->sab", direction, direction)
    walks = length >= STANDING * seconds
    return ((cosine < math.cos(OPPOSITE)) & walks[:, :, None] & walks[:, None, :]).any(axis=(1, 2))


def _order(positions: FloatArray) -> IntArray:
    """The agents of each window by where they start along the main axis of travel, (sets, agents)."""
    travel = (positions[:, -1] - positions[:, 0]).reshape(-1, 2)
    axis = np.linalg.eigh(travel.T @ travel)[1][:, 1]
    axis *= np.sign(axis[np.abs(axis).argmax()])
    return np.argsort(positions[:, 0] @ axis, axis=1, kind="stable")


# What is said about it


def _longest(tracks: _Tracks, agents: int) -> float:
    """For how many frames at most the same `agents` tracks are present together."""
    best = 0
    ends: list[int] = []
    for first, last in sorted(zip(tracks.first.tolist(), tracks.last.tolist(), strict=True)):
        heapq.heappush(ends, last)
        if len(ends) > agents:
            heapq.heappop(ends)
        if len(ends) == agents:  # of all that began, those that stay longest
            best = max(best, ends[0] - first)
    return best


def _nothing(found: _Found, agents: int, seconds: float, near: float, longest: float) -> str:
    """Why there is no window, and what to change."""
    together = (
        f"the longest that {agents} are present together is {longest:.2f} s"
        if agents > 1
        else (f"the longest is {longest:.2f} s")
    )
    there = f"no window in {found.tracks} tracks, {together}"
    if longest <= 0:
        return f"agents={agents}: {there}, expected fewer agents"
    if longest < seconds:
        return f"seconds={seconds:g}: {there}, expected less than that"
    if not found.sets:
        return f"near={near:g}: {there}, but no {agents} of {seconds:g} s come that close in m, expected more"
    if not found.inside:
        return f"seconds={seconds:g}: {there}, all {found.sets} meetings are too near to a track's end, expected less"
    return f"opposite=True: {there}, in {found.inside} meetings nobody walks in opposite directions, expected False"


def _windows_found(found: _Found, agents: int, seconds: float, near: float, opposite: bool) -> str:
    short = f"{found.tracks - found.long} tracks are shorter than {seconds:g} s."
    if agents == 1:
        return f"{short} The others give {found.windows} windows."
    aligned = f", in {found.inside - found.windows} no two walk in opposite directions" if opposite else ""
    return (
        f"{short} Of the others {found.sets} sets of {agents} come within {near:g} m of each other: "
        f"{found.sets - found.inside} meet too near to a track's end{aligned}, {found.windows} are windows."
    )


def _sizes(x: Tensor, scale: float) -> str:
    """The scale, and radii with the share of windows that each makes infeasible."""
    middle = float(x.abs().flatten(1).amax(dim=1).median())
    text = f"A workspace unit is {scale:.3g} m; half of the windows reach no further than {middle:.2f}."
    if x.shape[2] < 4:
        return text
    distance = closest(x).double().sort().values
    radii: dict[float, str] = {}  # few windows may have the same for several shares
    for share in QUANTILES:
        reached = float(distance[math.ceil(share * len(distance)) - 1])
        radius = (math.floor(1000 * reached) + 1) / 1000  # as it is printed, and above
        infeasible = float((distance < radius).double().mean())
        radii[radius] = f"{radius:.3f} ({radius * scale:.2f} m) makes {100 * infeasible:.0f} %"
    return f"{text} As constraint.radius, {', '.join(radii.values())} of them infeasible."
