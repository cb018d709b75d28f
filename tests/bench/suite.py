"""The whole bench, from the first measurement to its file, and back from the file."""

import json
import os
import tempfile
from collections.abc import Callable
from contextlib import chdir
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from unittest.mock import patch

import torch
from rich.console import Console

from conflow.errors import ConfigError
from conflow.figures.workspace import save
from conflow.tracking import recording, store
from conflow.training.progress import ProgressDisplay
from tests.bench import peers, quality, sampling, scaling, training, whole
from tests.bench.clock import Pace, Row, Target
from tests.bench.quality import Curve
from tests.bench.scaling import Point

PRESET = "quick"
REFERENCE = store.RUNS / "reference" / "bench.json"
FILE = "bench.json"


@dataclass(frozen=True)
class Bench:
    """All that was measured.

    Attributes:
        origin: when, on what, with which revision and versions.
        rows: the lines of the tables.
        points: how time and memory grow.
        curves: validations of finished runs.
    """

    origin: dict[str, str]
    rows: list[Row]
    points: list[Point]
    curves: list[Curve]

    @classmethod
    def read(cls, path: Path) -> "Bench":
        """What `measure` left in a file.

        Raises:
            ConfigError: it is none.
        """
        try:
            found = json.loads(path.read_text())
            rows = [Row(**{**row, "target": row["target"] and Target(**row["target"])}) for row in found["rows"]]
            points, curves = [Point(**one) for one in found["points"]], [Curve(**one) for one in found["curves"]]
            return cls(found["origin"], rows, points, curves)
        except FileNotFoundError:
            raise ConfigError(f"{path}: expected a bench, as a checkout of the repository has it, found none") from None
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise ConfigError(f"{path}: expected a bench, found {' '.join(str(error).split())}") from None


def measure(console: Console, pace: Pace | None = None) -> Path:
    """Measure everything, write it into a new folder under runs/bench/, and return the file.

    The training and the runs that it takes happen in a folder and a store of their own, which are thrown away.
    """
    pace, started = pace or Pace(), datetime.now()
    curves, origin = quality.curves(PRESET), _origin(started)
    sections: dict[str, Callable[[], list[Row]]] = {
        "training at paper size": lambda: training.rows("paper", Pace(min(pace.rounds, 5), pace.at_least)),
        "training at quick size": lambda: training.rows("quick", pace),
        "source": lambda: sampling.source(pace),
        "correction": lambda: sampling.correction(pace),
        "ODE": lambda: sampling.ode(Pace(min(pace.rounds, 5), pace.at_least)),
        "plans": lambda: sampling.plan(pace),
        "demonstrations": sampling.demonstrations,
        "start": lambda: sampling.start(pace),
        "a whole run": lambda: whole.rows(PRESET),
    }
    rows: list[Row] = []
    with (
        tempfile.TemporaryDirectory() as elsewhere,
        chdir(elsewhere),
        patch.dict(os.environ),
        ProgressDisplay(console) as display,
    ):
        os.environ.pop("MLFLOW_TRACKING_URI", None)
        task = display.add("bench", len(sections) + 1)
        for done, (name, section) in enumerate(sections.items()):
            display.update(task, done, name)
            rows += section()
        display.update(task, len(sections), "growth")
        points = scaling.points(Pace(min(pace.rounds, 3), pace.at_least))
        display.update(task, len(sections) + 1)
    bench = Bench(origin, [*rows, *quality.rows(curves, PRESET)], points, curves)
    folder = store.RUNS / "bench" / started.strftime("%Y-%m-%d-%H%M%S")
    folder.mkdir(parents=True)
    (folder / FILE).write_text(json.dumps(asdict(bench), indent=1) + "\n")
    pictures = {"scaling": scaling.figure(points)} | ({"time_to_quality": quality.figure(curves)} if curves else {})
    save(pictures, folder)
    return folder / FILE


def _origin(started: datetime) -> dict[str, str]:
    versions = {"torch": torch.__version__} | peers.versions()
    return {
        "date": started.strftime("%Y-%m-%d"),
        **recording.origin(),
        "versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }
