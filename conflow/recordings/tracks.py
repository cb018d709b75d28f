"""Tracks: who was where when, without what contradicts itself, filled where little is missing."""

from pathlib import Path

import numpy as np
import pandas as pd

from conflow.errors import ConfigError
from conflow.recordings.table import BoolArray, FloatArray, IntArray, Table

GAP = 0.5
"""Seconds: a track is filled linearly where at most this long nothing of it was seen, and split where longer."""


class Tracks:
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

    def select(self, which: BoolArray) -> "Tracks":
        """The tracks of a mask."""
        rows = np.repeat(which, self.size)
        start = np.cumsum(self.size[which]) - self.size[which]
        return Tracks(self.frame[rows], self.x[rows], start, self.ids[which], self.step)


def tracks_of(path: str | Path, table: Table, fps: float) -> tuple[Tracks, str]:
    """The tracks of a table, and how they came about.

    Raises:
        ConfigError: no row can be used.
    """
    rows = pd.DataFrame({"id": table.id, "frame": table.frame, "x": table.x[:, 0], "y": table.x[:, 1]})
    seen = rows[np.isfinite(table.x).all(axis=1)]
    single = seen.drop_duplicates()
    kept = single.drop_duplicates(["id", "frame"], keep=False).sort_values(["id", "frame"])
    left_out = _listed(
        (len(seen) - len(single), "repeated rows"),
        (len(single) - len(kept), "rows that put an agent at two places in one frame"),
        (len(rows) - len(seen), "rows without a position"),
    )
    if not len(kept):
        raise ConfigError(f"from={path}: has {left_out}, expected some others; {table.says}")

    ids, frame, x = kept["id"].to_numpy(), kept["frame"].to_numpy(), kept[["x", "y"]].to_numpy()
    same, distance = np.diff(ids) == 0, np.diff(frame)
    step = int(np.median(distance[same])) if same.any() else 1
    gap = same & (distance - step > GAP * fps + 1e-9)
    filled = same & ~gap & (distance >= 2 * step)
    start = np.flatnonzero(np.concatenate([[True], ~same | gap]))
    read_in = (
        f"{len(rows)} rows, {table.says}; {fps:g} frames per second, in steps of {step}. Left out: "
        f"{left_out}. {len(np.unique(ids))} ids make {len(start)} tracks, with {int(filled.sum())} gaps of up to "
        f"{GAP:g} s filled and {int(gap.sum())} longer ones split."
    )
    return Tracks(frame, x, start, ids[start], step), read_in


def _listed(*counts: tuple[int, str]) -> str:
    return ", ".join(f"{count} {what}" for count, what in counts if count) or "nothing"
