"""The configuration: typed settings, their ranges, and how files and arguments are laid over each other.

OmegaConf stays inside this file. What leaves it is a frozen `Config`; every default stands in `conf/base.yaml`.
"""

import dataclasses
import functools
import hashlib
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args, get_origin, get_type_hints

from conflow.errors import ConfigError, brief, nearest
from conflow.flow.settings import Correction, Guidance, Network, Solver, Source, Weight
from conflow.scene.settings import Constraint, Data, Obstacle
from conflow.tracking import code

PACKAGE = Path(__file__).parents[1]
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
"""Inside the package where it was installed from a wheel, beside it in a checkout."""

Schedule = Literal["constant", "one_cycle"]
Norm = Literal["waypoints", "modes"]
Precision = Literal["32", "bf16"]
Accelerator = Literal["auto", "cpu", "gpu", "mps"]
SplitName = Literal["val", "test"]
PAPERS_TASK = "swap"
SWAPS = ("passing", "social", PAPERS_TASK)
"""The tasks of two robots that swap sides: here, since a mistyped setting is answered without torch."""
Tree = dict[str, Any]

SPLITS: dict[SplitName, str] = {"val": "validation", "test": "test"}
"""The splits that are held out, and what each is called in titles and in the names of metrics."""

OF_TASK = "task."
"""Begins the settings that are a task's own."""
LATER: dict[str, Tree] = {
    "data": {"unrepaired": 0.0},
    "train": {"precision": "32"},
    "sample": {"descent": 0, "guidance_steps": 4, "object_radius": None},
}
"""Settings that earlier runs lack, with their defaults: here, since a planner reads no YAML."""
SIZES = (
    "data.num",
    "network.hidden",
    "network.blocks",
    "train.max_steps",
    "train.batch_size",
    "train.log_every",
    "train.val_every",
    "sample.num",
)
"""How much is computed: whole numbers that presets set, and that an ablation or a task may only multiply."""
OF_SWAPS = (
    *("data.horizon", "data.amplitudes", "data.jitter", "constraint.radius"),
    *("sample.obstacle.", "sample.radius", "sample.object_radius"),
)
"""Settings of SWAPS; another task has its own, `task.NAME`, or says in its file what these do."""
MOST_NUMBERS = 64
"""The longest list that a setting may be: OmegaConf takes its time over each number."""


@dataclass(frozen=True)
class Range:
    """The values that a numeric setting may take: [low, high], or (above, high]."""

    low: float = -math.inf
    high: float = math.inf
    above: float = -math.inf

    def __contains__(self, value: float) -> bool:
        # Compared, not converted: a whole number may be too large for a float.
        return self.low <= value <= self.high and value > self.above and abs(value) < math.inf

    def __str__(self) -> str:
        bounds = {"above": self.above, "of at least": self.low, "at most": self.high}
        return " and ".join(f"{word} {bound:.16g}" for word, bound in bounds.items() if math.isfinite(bound))


Positive = Annotated[float, {"above": 0, "high": 1e9}]
Count = Annotated[int, {"low": 1, "high": 10**9}]


@dataclass(frozen=True)
class Train:
    max_steps: Count
    batch_size: Count
    lr: Positive
    schedule: Schedule
    clip: Positive
    norm: Norm
    precision: Precision
    log_every: Count
    val_every: Count
    accelerator: Accelerator


@dataclass(frozen=True)
class Sample:
    num: Annotated[int, {"low": 2, "high": 10**9}]
    solver: Solver
    steps: Count
    guidance: Guidance
    guidance_steps: Count
    descent: Annotated[int, {"low": 0, "high": 10**6}]
    robot_weight: Weight
    obstacle_weight: Weight
    obstacle: Obstacle
    radius: Annotated[float | None, {"above": 0, "high": 2}]
    object_radius: Annotated[float | None, {"above": 0, "high": 2}]


@dataclass(frozen=True)
class Config:
    """One experiment. The comments of `conf/base.yaml` say what each setting is.

    Attributes:
        of_task: what the task is made with, `task.NAME=value` in arguments: numbers, texts, or lists of numbers.
    """

    task: str
    ablation: str
    preset: str
    seed: Annotated[int, {"low": 0, "high": 2**32 - 1}]
    data: Data
    source: Source
    constraint: Constraint
    correction: Correction
    network: Network
    train: Train
    sample: Sample
    of_task: Tree = dataclasses.field(default_factory=dict)

    def tree(self) -> Tree:
        """The whole as nested dictionaries of plain values; those of the task have their whole key, `task.NAME`."""
        tree = dataclasses.asdict(self)
        return tree | {f"{OF_TASK}{name}": value for name, value in tree.pop("of_task").items()}

    def identity(self) -> Tree:
        """The settings that say which experiment this is: all but the accelerator, on which it may go on elsewhere."""
        tree = self.tree() | {"task": self.task_name}
        for group, defaults in LATER.items():  # runs from before there was such a thing are of the same experiment
            tree[group] = {name: value for name, value in tree[group].items() if defaults.get(name, ...) != value}
        del tree["train"]["accelerator"]
        if is_file(self.task):
            tree["task_code"] = code.of_file(Path(self.task))
        return tree

    @property
    def task_name(self) -> str:
        """The task's, whatever folder its file is in."""
        return Path(self.task).stem if is_file(self.task) else self.task

    @property
    def name(self) -> str:
        """ABLATION-sSEED, behind the task where that is not the paper's."""
        own = f"{self.ablation}-s{self.seed}"
        return own if self.task == PAPERS_TASK else f"{self.task_name}-{own}"

    def sha(self) -> str:
        """A fingerprint of `identity`, 16 hexadecimal digits."""
        import yaml

        return hashlib.sha256(yaml.safe_dump(self.identity()).encode()).hexdigest()[:16]


def is_file(task: str) -> bool:
    """Whether a task is a Python file of one's own, and none of the names under conf/task/."""
    return task.endswith(".py")


def check_file(task: str) -> None:
    """Refuse a file that is called as a named task is: runs, records and commands of both would have one name.

    Raises:
        ConfigError: it is.
    """
    if is_file(task) and (name := Path(task).stem) in names("task"):
        expected = f"expected another name than that of the task {name}, for which its runs would be taken"
        raise ConfigError(f"task={brief(task)}: {expected}; try: rename the file")


def names(axis: str) -> list[str]:
    """The tasks, ablations or presets that exist: the files under conf/<axis>/."""
    return sorted(file.stem for file in (CONF / axis).glob("*.yaml"))


def arguments_of(settings: Mapping[str, Any]) -> list[str]:
    """Settings by keyword as arguments `key=value`, such as train__max_steps=100 as train.max_steps=100."""
    return [f"{key.replace('__', '.')}={'null' if value is None else value}" for key, value in settings.items()]


def load(arguments: Sequence[str] = ()) -> Config:
    """conf/base.yaml, then task, preset and ablation, then arguments `key=value`, checked.

    A task's `like: FILE` is another file under conf/, over which the task's own settings are laid. A block `times` of a
    task or an ablation multiplies what base and preset say, so that lengths follow every preset.

    Raises:
        ConfigError: an unknown name, a value of the wrong type or out of range.
    """
    from omegaconf import OmegaConf

    pairs = [split(argument) for argument in arguments]
    of_task = {key: _plain(key, value) for key, value in pairs if key.startswith(OF_TASK)}
    pairs = [(key, value) for key, value in pairs if key not in of_task]
    base = _read("base")
    chosen = {axis: str(dict(pairs).get(axis, base[axis])) for axis in ("task", "preset", "ablation")}
    for axis, name in chosen.items():
        if name not in names(axis) and not (axis == "task" and is_file(name)):
            known = ", ".join([*names(axis), *(["a file FILE.py"] if axis == "task" else [])])
            raise ConfigError(f"{axis}={brief(name)}: expected one of {known}{nearest(name, names(axis))}")
    check_file(chosen["task"])
    task = {} if is_file(chosen["task"]) else _read(f"task/{chosen['task']}")
    if "like" in task:
        task = _read(task.pop("like")) | task
    preset, ablation = (_read(f"{axis}/{chosen[axis]}") for axis in ("preset", "ablation"))
    multiplied = [
        _factors(f"conf/{axis}/{chosen[axis]}.yaml", tree.pop("times", {}))
        for axis, tree in (("task", task), ("ablation", ablation))
    ]
    settings = _schema(Config)
    for key, value in (flatten(base) | flatten(task) | flatten(preset)).items():
        _set(settings, key, value)
    for factors in multiplied:
        for key, factor in factors.items():
            _set(settings, key, _multiplied(key, OmegaConf.select(settings, key), factor))
    for key, value in [*flatten(ablation).items(), *pairs]:
        _set(settings, key, value)
    _check_of_swaps(chosen["task"], pairs)
    return from_tree(_container(settings) | of_task)


def _check_of_swaps(task: str, pairs: Sequence[tuple[str, str]]) -> None:
    """Refuse settings of the swaps where the task is none of them and would not hear of them."""
    for key, value in pairs if task not in SWAPS else ():
        if key.startswith(OF_SWAPS):
            expected = f"expected one of the tasks {', '.join(SWAPS)}, which it belongs to"
            raise ConfigError(f"{key}={brief(value)}: {expected}")


def _plain(key: str, text: str) -> Any:
    """What a task's own setting means: a number, true or false, null, a list of numbers, or else the text itself."""
    import yaml

    try:
        value = yaml.safe_load(text) if re.fullmatch(r"[\w.+-]*|\[[\w.+, -]*\]", text) else text
    except yaml.YAMLError:
        value = text
    value = [_number(one) for one in value] if isinstance(value, list) else _number(value)
    if isinstance(value, list) and not (all(type(one) in (int, float) for one in value) and len(value) <= MOST_NUMBERS):
        raise ConfigError(f"{brief(key)}={brief(text)}: expected {_describe(list[float])}")
    return value if isinstance(value, bool | int | float | list | None) else text


def _number(value: Any) -> Any:
    """The number of a text such as 1e-5, which YAML 1.1 reads as a number only with a dot and a sign."""
    number = isinstance(value, str) and re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+", value)
    return float(value) if number else value


def _factors(file: str, times: Any) -> dict[str, float]:
    """What the block `times` of a task or an ablation multiplies, by the setting's dotted key.

    Raises:
        ConfigError: names the file; a setting that is none of SIZES, or a factor that is no number above 0.
    """
    if not isinstance(times, dict):
        raise ConfigError(f"{file}: times: expected settings and what to multiply them by, found {brief(times)}")
    factors, allowed = flatten(times), Range(above=0, high=1e9)
    for key, factor in factors.items():
        if key not in SIZES:
            expected = f"expected one of {', '.join(SIZES)}{nearest(key, SIZES)}"
            raise ConfigError(f"{file}: times.{brief(key)}={brief(factor)}: {expected}")
        number = isinstance(factor, int | float) and not isinstance(factor, bool)
        if not number or factor not in allowed:
            raise ConfigError(f"{file}: times.{key}={brief(factor)}: expected a number {allowed}")
    return factors


def _multiplied(key: str, number: int, factor: float) -> int:
    """A whole number times a factor, rounded, and at least what the setting takes."""
    low = next(allowed.low for name, _, allowed in _fields() if name == key)
    return max(int(low), round(number * factor))


def from_tree(tree: Any) -> Config:
    """The Config that `Config.tree` wrote, checked again.

    Raises:
        ConfigError: as `load`; also where a setting is missing.
    """
    own = {key: value for key, value in tree.items() if str(key).startswith(OF_TASK)} if isinstance(tree, dict) else {}
    config = _built(Config, {key: value for key, value in tree.items() if key not in own} if own else tree)
    assert isinstance(config, Config)
    config = dataclasses.replace(config, of_task={key.removeprefix(OF_TASK): value for key, value in own.items()})
    _check(config)
    return config


def completed(tree: Any) -> Any:
    """What `Config.tree` wrote at some time, with the defaults of the settings that came later."""
    if not isinstance(tree, dict):
        return tree  # which `from_tree` refuses
    groups = {key: value for key, value in tree.items() if isinstance(value, dict)}
    return tree | {group: defaults | groups[group] for group, defaults in LATER.items() if group in groups}


def _built(cls: type, tree: Any, prefix: str = "") -> Any:
    """The dataclass of a tree of plain values, without OmegaConf, which takes its time."""
    hints = {name: kind for name, kind in get_type_hints(cls).items() if kind != Tree}
    if not isinstance(tree, dict):
        raise ConfigError(f"{prefix.removesuffix('.') or 'settings'}={brief(tree)}: expected nested settings")
    for key in map(str, tree):
        if key not in hints:
            known = f"expected one of conf/base.yaml{nearest(prefix + key, list(_types()))}"
            raise ConfigError(f"{brief(prefix + key)}: no such setting, {known}")
    values = {}
    for key, kind in hints.items():
        if key not in tree:
            raise ConfigError(f"{prefix}{key}: expected a value, found none")
        value = tree[key]
        if dataclasses.is_dataclass(kind):
            values[key] = _built(cast(type, kind), value, f"{prefix}{key}.")
            continue
        whole = kind in (float, float | None) and type(value) is int and abs(value) <= sys.float_info.max
        values[key] = float(value) if whole else value
        if not _fits(values[key], kind):
            raise ConfigError(f"{prefix}{key}={brief(value)}: expected {_describe(kind)}")
    return cls(**values)


def _fits(value: Any, kind: Any) -> bool:
    """Whether a plain value is of a setting's type."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if kind == list[float]:
        numbers = isinstance(value, list) and all(type(one) in (int, float) for one in value)
        return numbers and len(value) <= MOST_NUMBERS
    of_kind = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    return of_kind and not _refers(value)


def override(config: Config, arguments: Sequence[str], allowed: Sequence[str]) -> Config:
    """The config with arguments `key=value` laid over it, of which only those that begin as allowed may come.

    Raises:
        ConfigError: as `load`; also for a key that is not allowed.
    """
    settings = _schema(Config)
    of_task = {f"{OF_TASK}{name}": value for name, value in config.of_task.items()}
    for key, value in flatten(config.tree()).items():
        if key not in of_task:
            _set(settings, key, value)
    for key, value in map(split, arguments):
        _set(settings, key, value)
        if not key.startswith(tuple(allowed)):
            expected = f"expected settings of {' and '.join(allowed)} only"
            raise ConfigError(f"{key}={brief(value)}: fixed by the run, {expected}")
    _check_of_swaps(config.task, list(map(split, arguments)))
    return from_tree(_container(settings) | of_task)


def flatten(tree: Tree, prefix: str = "") -> Tree:
    """Nested settings as one dictionary with dotted keys."""
    flat: Tree = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _fields(cls: type = Config, prefix: str = "") -> Iterator[tuple[str, Any, Range]]:
    """Every setting's dotted key, type and range."""
    for name, annotation in get_type_hints(cls, include_extras=True).items():
        kind, bounds = get_args(annotation) if get_origin(annotation) is Annotated else (annotation, {})
        if kind == Tree:
            continue  # of the task, which knows them itself
        if dataclasses.is_dataclass(kind):
            yield from _fields(cast(type, kind), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", kind, Range(**bounds)


@functools.cache
def _types() -> dict[str, Any]:
    """Every setting's type by its dotted key."""
    return {name: kind for name, kind, _ in _fields()}


def _schema(cls: type) -> Any:
    """The typed tree with every setting missing; open for writing although the dataclasses are frozen."""
    from omegaconf import OmegaConf

    node = OmegaConf.structured(cls)
    OmegaConf.set_readonly(node, False)
    for name, kind in get_type_hints(cls).items():
        if dataclasses.is_dataclass(kind):
            node[name] = _schema(cast(type, kind))
    return node


def _container(settings: Any) -> Tree:
    """The typed tree as plain values, without the place of what is the task's."""
    from omegaconf import OmegaConf

    tree = OmegaConf.to_container(settings)
    assert isinstance(tree, dict)
    return {str(key): value for key, value in tree.items() if key != "of_task"}


def _read(name: str) -> Tree:
    import yaml

    try:
        tree = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    except (OSError, yaml.YAMLError) as error:
        raise ConfigError(f"conf/{name}.yaml: {' '.join(str(error).split())}") from None
    if not isinstance(tree, dict):
        raise ConfigError(f"conf/{name}.yaml: expected settings, found {tree!r}")
    return tree


def split(argument: str) -> tuple[str, str]:
    """Key and value of an argument `key=value`."""
    key, equals, value = argument.partition("=")
    if not equals:
        raise ConfigError(f"{brief(argument)}: expected key=value")
    return key.strip(), value.strip()


def _set(settings: Any, key: str, value: Any) -> None:
    """Set one key to a value, or to the value that an argument's text means for a setting of its type."""
    import yaml
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    types = _types()
    if key not in types:
        raise ConfigError(f"{brief(key)}: no such setting, expected one of conf/base.yaml{nearest(key, list(types))}")
    try:
        parsed = _parse(value, types[key]) if isinstance(value, str) else value
        if _refers(parsed):
            raise ValueError
        OmegaConf.update(settings, key, parsed, merge=False)
    except (OmegaConfBaseException, yaml.YAMLError, ValueError, OverflowError, RecursionError):
        raise ConfigError(f"{key}={brief(value)}: expected {_describe(types[key])}") from None


def _parse(text: str, kind: Any) -> Any:
    """Text is itself where text is wanted: YAML would turn a name such as `on` into a truth value."""
    if kind is str or get_origin(kind) is Literal:
        return text
    if kind == str | None:
        return None if text in ("", "null") else text
    import yaml

    if kind == list[float]:
        numbers = yaml.safe_load(text)
        if isinstance(numbers, list) and len(numbers) > MOST_NUMBERS:
            raise ValueError
        return numbers
    # YAML has more to say than a number: anchors, tags, comments.
    if not re.fullmatch(r"[\w.+-]*", text):
        raise ValueError
    value = yaml.safe_load(text)
    if kind is bool and not isinstance(value, bool):  # OmegaConf takes any number for one
        raise ValueError
    return value


def _refers(value: Any) -> bool:
    """Whether OmegaConf would take a value for a reference to another, or to the environment, or for none."""
    return "${" in str(value) or value == "???"


def _describe(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return "one of " + ", ".join(get_args(kind))
    words = {
        int: "a whole number",
        float: "a finite number",
        bool: "true or false",
        str: "a name",
        list[float]: f"[a, b, ...] of at most {MOST_NUMBERS} numbers",
        int | None: "a whole number or null",
        float | None: "a finite number or null",
    }
    return words.get(kind, "a text without ${, or null")


def _check(config: Config) -> None:
    values = flatten(config.tree())
    for key, kind, allowed in _fields():
        for value in values[key] if isinstance(values[key], list) else [values[key]]:
            if isinstance(value, int | float) and value not in allowed:
                raise ConfigError(f"{key}={brief(values[key])}: expected {_describe(kind)} {allowed}")
    if not config.data.amplitudes:
        raise ConfigError("data.amplitudes=[]: expected at least one amplitude")
    if config.correction.width % 2 == 0:
        raise ConfigError(f"correction.width={config.correction.width}: expected an odd number of taps")
    if config.data.val_fraction + config.data.test_fraction >= 1:
        raise ConfigError(
            f"data.test_fraction={config.data.test_fraction}: expected less than 1 together with "
            f"data.val_fraction={config.data.val_fraction}"
        )
    if config.correction.at == "end" and config.correction.path == "guided":
        raise ConfigError("correction.path=guided: expected correction.at=point, the path is guided at its own points")
    if config.correction.at != "end" and config.correction.ramp != 1:
        raise ConfigError(f"correction.ramp={config.correction.ramp}: expected correction.at=end, which it belongs to")
    if config.correction.at == "end" and config.correction.mask != "violates":
        expected = "expected correction.at=point, at the end the barrier is its own mask"
        raise ConfigError(f"correction.mask={config.correction.mask}: {expected}")
    if config.data.negative_share is not None and not config.data.negatives:
        raise ConfigError(f"data.negative_share={config.data.negative_share}: expected data.negatives=true")
    if config.data.repair and not config.correction.margin:
        # Repair comes as near to the boundary as it wants, from within: without a margin the label would not change.
        raise ConfigError("correction.margin=0.0: expected a number above 0 where data.repair=true")
    if config.data.unrepaired and not config.data.repair:
        raise ConfigError(
            f"data.unrepaired={config.data.unrepaired}: expected data.repair=true, of which it is the rest"
        )
    if config.constraint.pairs == "all" and config.constraint.reduction == "closest":
        # The closest approach is one pair's; all of them at every waypoint are the sum.
        expected = "expected sum or mean where constraint.pairs=all, or constraint.pairs=nearest"
        raise ConfigError(f"constraint.reduction=closest: {expected}")
    if config.source.kind == "gaussian" and (
        config.correction.smoothing == "covariant" or config.network.kind != "resmlp"
    ):
        raise ConfigError("source.kind=gaussian: expected gp or cgp where the source's covariance is asked for")
    if config.train.norm == "modes" and config.network.kind == "resmlp":
        raise ConfigError("train.norm=modes: expected network.kind=spectral or attention, which have modes")
    if config.network.sees_ends and config.network.kind != "resmlp":
        raise ConfigError("network.sees_ends=True: expected network.kind=resmlp, others take start and goal from x")
    if config.correction.keep_ends and config.correction.smoothing == "covariant":
        raise ConfigError("correction.keep_ends=True: expected correction.smoothing=filter, covariant always does")
    if config.source.fit and config.source.kind == "gaussian":
        raise ConfigError("source.fit=True: expected source.kind gp or cgp, the standard normal has nothing to fit")
