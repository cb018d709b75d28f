"""What is compared of a finished run: read from MLflow, or from a file of record under runs/reference/."""

import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path

from mlflow.entities import Run

from conflow.errors import ConfigError
from conflow.tracking import code, recording, store
from conflow.training import config
from conflow.training.config import OF_TASK, PAPERS_TASK, SPLITS, SplitName, flatten
from conflow.training.evaluation import EVALUATED_ON_VALIDATION

FOLDER = store.RUNS / "reference" / "runs"
LONGEST = 200
"""Characters of a name of a file or folder; systems allow 255 bytes."""
PUBLISHED = ("test/", "validation/", "without_model/", "source/", "evaluate/")
VALIDATED = {"validation/": "test/", EVALUATED_ON_VALIDATION: "evaluate/"}
"""How metrics of the validation split begin, and those of the test split that they correspond to."""
SUCCESS = re.compile(r"/success_(rate|low|high|count)$")
ORIGIN = ("code_sha", "code", "git_sha", "git_dirty", "data_digest", "versions", "hardware", "threads", "resumed")
PRECISION = "train.precision"
DEMONSTRATED = ("data.path", "data.num", "data.horizon", "data.amplitudes", "data.jitter", "data.seed")
"""The settings that decide what is demonstrated; other ones of `data` say what is learned of it."""


@dataclass(frozen=True)
class Record:
    """One run's numbers, and all that is needed to get them again.

    Attributes:
        run_id: in the store that it was tracked in.
        settings: its whole config, flat, as text.
        metrics: the results, without the curves of training.
        origin: the program's revision, versions, hardware and data that it was made with.
        seconds: that it was trained and evaluated, without those in which it was interrupted.
    """

    run_id: str
    ablation: str
    preset: str
    seed: int
    settings: dict[str, str]
    metrics: dict[str, float]
    origin: dict[str, str]
    seconds: float

    @classmethod
    def of(cls, run: Run) -> "Record":
        """The record of a finished run."""
        tags = run.data.tags
        metrics = {key: value for key, value in sorted(run.data.metrics.items()) if key.startswith(PUBLISHED)}
        if not any(key.startswith("validation/") for key in metrics):
            # The same change made success what it is now; before, it ignored the obstacle and passed between waypoints.
            metrics = {SUCCESS.sub(r"/success_at_waypoints_\1", key): value for key, value in metrics.items()}
        origin = {key: tags[key] for key in ORIGIN if key in tags}
        settings = dict(sorted(run.data.params.items()))
        where = (str(run.info.run_id), tags["ablation"], tags["preset"], int(tags["seed"]))
        return cls(*where, settings, metrics, origin, recording.at_work(run))

    @classmethod
    def read(cls, path: Path) -> "Record":
        """The record that `write` left in a file.

        Raises:
            ConfigError: it is none.
        """
        try:
            return cls(**json.loads(path.read_text()))
        except (OSError, ValueError, TypeError) as error:
            raise ConfigError(f"{path}: expected the record of a run, found {' '.join(str(error).split())}") from None

    def write(self, folder: Path) -> Path:
        """The file of this record in a folder; where one of another run of the same experiment was, it is replaced."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / self.file
        path.write_text(json.dumps(asdict(self), indent=1) + "\n")
        return path

    def measured(self, split: SplitName) -> bool:
        """Whether the run was measured on a split; of one from before there is the test split alone."""
        return any(key.startswith(f"{SPLITS[split]}/") for key in self.metrics)

    def on(self, split: SplitName) -> "Record":
        """The record with the results of one split alone, under the test split's names, which the tables read."""
        metrics = {}
        for key, value in self.metrics.items():
            of_validation = next((prefix for prefix in VALIDATED if key.startswith(prefix)), None)
            if of_validation is None:
                if split == "test" or not key.startswith(tuple(VALIDATED.values())):
                    metrics[key] = value
            elif split == "val":
                metrics[VALIDATED[of_validation] + key.removeprefix(of_validation)] = value
        return replace(self, metrics=metrics)

    @property
    def task(self) -> str:
        """The task's name; runs from before there were several are of the paper's."""
        return self.settings.get("task", PAPERS_TASK)

    @property
    def name(self) -> str:
        """The run's."""
        own = f"{self.ablation}-s{self.seed}"
        return own if self.task == PAPERS_TASK else f"{self.task}-{own}"

    @property
    def file(self) -> str:
        """The name of the file that it is written to, which says all that `changes` does."""
        parts = [*([] if self.task == PAPERS_TASK else [self.task]), self.ablation, self.preset, *self.changes]
        said, seed = "-".join(parts), f"-s{self.seed}.json"
        # Letters, digits and what settings are made of; anything else would be no name of a file everywhere.
        name = re.sub(r"[^\w.=+-]+", "_", said)
        if len(name) > LONGEST:  # as of many changes, or of old runs where a preset was changed since
            name = f"{name[:LONGEST]}-{hashlib.sha256(said.encode()).hexdigest()[:8]}"
        return name + seed

    @property
    def digest(self) -> str | None:
        """The fingerprint of the demonstrations."""
        return self.origin.get("data_digest")

    @property
    def demonstrated(self) -> str:
        """The settings of which the demonstrations follow, but for what a file holds, as text."""
        made_by = (*DEMONSTRATED, "constraint.radius")  # at which some generators let robots touch
        return str({key: value for key, value in self.settings.items() if key.startswith("task") or key in made_by})

    @cached_property
    def changes(self) -> list[str]:
        """The settings that are not those of the task and the ablation at the preset, as arguments."""
        axes = [f"ablation={self.ablation}", f"preset={self.preset}", f"seed={self.seed}"]
        named = flatten(config.load([*axes, *self.of_task]).tree()) | {"task": self.task}
        # A setting that came later counts as its default; one of the task's own is never there by default.
        changed = {
            key: value
            for key, value in self.settings.items()
            if value != str(named.get(key, None if key.startswith(OF_TASK) else value))
        }
        return [f"{key}={'null' if value == 'None' else value}" for key, value in changed.items()]

    @property
    def machine(self) -> str:
        """The precision of the network's layers in training, and the hardware."""
        precision = self.settings.get(PRECISION, "32").replace("32", "32 bits")
        return f"{precision} on {self.origin.get('hardware', 'an unknown machine')}"

    @property
    def reading(self) -> list[str]:
        """The changes that are no matter of the machine: all but the precision."""
        return [change for change in self.changes if not change.startswith(f"{PRECISION}=")]

    @property
    def of_preset(self) -> bool:
        """Whether this is its task, ablation and preset as they stand, in whichever precision."""
        return not self.reading

    @property
    def chosen(self) -> str:
        """What `TASK=` was: the task's name, or of one's own that of its file, whose folder no record keeps."""
        return self.task if self.of_task else f"{self.task}.py"

    @property
    def of_task(self) -> list[str]:
        """The argument that chooses the task, where it is one that has a name here."""
        return [f"task={self.task}"] if self.task in config.names("task") else []


def finished(preset: str) -> list[Run]:
    """The finished runs at a preset, those of the present code first, the newest of either first.

    But for those of an ablation whose file is gone, of which nobody can say what was changed.
    """
    known = config.names("ablation")
    runs = [run for run in store.runs("FINISHED", preset=preset) if run.data.tags["ablation"] in known]
    return sorted(runs, key=lambda run: bool(code.differing(run.data.tags)))


def from_store(preset: str, arguments: Sequence[str] = ()) -> list[Record]:
    """The first of the `finished` runs of every ablation and seed at a preset, with arguments as they were trained.

    All on the same demonstrations, those of the first: a file's, or a generator's, may have changed between two runs.
    """
    newest: dict[tuple[str, int], Record] = {}
    digests: dict[str, str | None] = {}
    for run in finished(preset):
        ablation, seed = run.data.tags["ablation"], int(run.data.tags["seed"])
        try:
            asked = config.load([f"ablation={ablation}", f"preset={preset}", f"seed={seed}", *arguments])
        except ConfigError:
            continue  # the arguments do not go with this ablation, so nobody has trained it with them
        if run.data.tags["config_sha"] == asked.sha():
            one = Record.of(run)
            if digests.setdefault(one.demonstrated, one.digest) == one.digest:
                newest.setdefault((ablation, seed), one)
    return sorted(newest.values(), key=lambda record: record.seed)


def others(preset: str, shown: Sequence[Record]) -> list[str]:
    """The finished runs at a preset that are of other tasks, data or settings than those shown, by name and change."""
    ids = {run.run_id for run in shown}
    known = {(run.ablation, run.seed, str(run.settings), run.digest) for run in shown}
    digests = {run.demonstrated: run.digest for run in shown}
    found: dict[str, None] = {}
    for run in store.runs("FINISHED", preset=preset):
        one = Record.of(run)
        if one.run_id in ids or (one.ablation, one.seed, str(one.settings), one.digest) in known:
            continue
        elsewhere = ["(on other data)"] if digests.get(one.demonstrated, one.digest) != one.digest else []
        try:
            found[" ".join([one.name, *one.changes, *elsewhere])] = None
        except ConfigError:
            found[one.name] = None
    return list(found)


def from_files() -> list[Record]:
    """All records under runs/reference/, by seed.

    Raises:
        ConfigError: there is none, or a file is none.
    """
    paths = sorted(FOLDER.glob("*.json"))
    if not paths:
        expected = f"expected records in {FOLDER}, as a checkout of the repository has them"
        raise ConfigError(f"reference: {expected}, found none; try: make reference")
    return sorted(map(Record.read, paths), key=lambda record: record.seed)


def publish(preset: str) -> list[Path]:
    """Write the first of the `finished` runs of every experiment and seed at a preset into runs/reference/.

    What has one file's name is one experiment, though its config may have another fingerprint, as where a task's file
    was edited.
    """
    newest: dict[str, Record] = {}
    for one in map(Record.of, finished(preset)):
        newest.setdefault(one.file, one)
    return [one.write(FOLDER) for one in newest.values()]
