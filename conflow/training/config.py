"""The configuration: typed settings, their ranges, and how files and arguments are laid over each other.

OmegaConf stays inside this file. What leaves it is a frozen `Config`; every default stands in `conf/base.yaml`.
"""

import dataclasses
import functools
import hashlib
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args, get_origin, get_type_hints

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from conflow.errors import ConfigError, brief, nearest
from conflow.flow.correction import Edges
from conflow.flow.sampler import Guidance, Solver
from conflow.scene.constraint import BarrierShape, Obstacle, Reduction

PACKAGE = Path(__file__).parents[1]
CONF = PACKAGE / "conf" if (PACKAGE / "conf").is_dir() else PACKAGE.parent / "conf"
"""Inside the package where it was installed from a wheel, beside it in a checkout."""

SourceKind = Literal["gaussian", "gp", "cgp"]
Schedule = Literal["constant", "one_cycle"]
NetworkKind = Literal["resmlp", "spectral"]
Smoothing = Literal["filter", "covariant"]
Place = Literal["point", "end"]
Mask = Literal["violates", "feasible"]
PathKind = Literal["linear", "guided"]
Norm = Literal["waypoints", "modes"]
Accelerator = Literal["auto", "cpu", "gpu", "mps"]
SplitName = Literal["val", "test"]
Tree = dict[str, Any]

SPLITS: dict[SplitName, str] = {"val": "validation", "test": "test"}
"""The splits that are held out, and what each is called in titles and in the names of metrics."""

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
"""How much is computed: whole numbers that presets set, and that an ablation does not set but may multiply."""
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


Positive = Annotated[float, Range(above=0, high=1e9)]
Weight = Annotated[float, Range(0, 1e9)]
# Their squares and inverses must stay numbers, also in single precision.
Scale = Annotated[float, Range(1e-6, 1e6)]
Count = Annotated[int, Range(1, 10**9)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Fraction = Annotated[float, Range(above=0, high=1)]


@dataclass(frozen=True)
class Data:
    path: str | None
    num: Annotated[int, Range(10, 10**8)]
    horizon: Annotated[int, Range(3, 4096)]
    amplitudes: Annotated[list[float], Range(0, 1)]
    jitter: Annotated[float, Range(0, 0.2)]
    seed: Seed
    negatives: bool
    negative_share: Annotated[float | None, Range(0, 1)]
    repair: bool
    val_fraction: Fraction
    test_fraction: Fraction


@dataclass(frozen=True)
class Source:
    kind: SourceKind
    length_scale: Scale
    sigma_f: Scale
    epsilon: Annotated[float, Range(1e-12, 1e6)]
    modes: Annotated[int | None, Range(1, 4096)]
    fit: bool


@dataclass(frozen=True)
class Constraint:
    radius: Annotated[float, Range(above=0, high=2)]
    barrier: BarrierShape
    gamma: Scale
    reduction: Reduction


@dataclass(frozen=True)
class Correction:
    lambda_c: Weight
    mask: Mask
    at: Place
    ramp: Annotated[float, Range(0, 100)]
    path: PathKind
    margin: Annotated[float, Range(0, 1)]
    walls: bool
    smoothing: Smoothing
    sigma: Scale
    width: Annotated[int, Range(1, 8191)]
    edges: Edges
    keep_ends: bool


@dataclass(frozen=True)
class Network:
    kind: NetworkKind
    hidden: Annotated[int, Range(1, 65536)]
    blocks: Annotated[int, Range(0, 1024)]
    sees_ends: bool


@dataclass(frozen=True)
class Train:
    max_steps: Count
    batch_size: Count
    lr: Positive
    schedule: Schedule
    clip: Positive
    norm: Norm
    log_every: Count
    val_every: Count
    accelerator: Accelerator


@dataclass(frozen=True)
class Sample:
    num: Annotated[int, Range(2, 10**9)]
    solver: Solver
    steps: Count
    guidance: Guidance
    robot_weight: Weight
    obstacle_weight: Weight
    obstacle: Obstacle
    radius: Annotated[float | None, Range(above=0, high=2)]


# Of settings whose dataclass stands in scene/.
RANGES = {
    "sample.obstacle.x": Range(-2, 2),
    "sample.obstacle.y": Range(-2, 2),
    "sample.obstacle.radius": Range(above=0, high=2),
}


@dataclass(frozen=True)
class Config:
    """One experiment. The comments of `conf/base.yaml` say what each setting is."""

    ablation: str
    preset: str
    seed: Seed
    data: Data
    source: Source
    constraint: Constraint
    correction: Correction
    network: Network
    train: Train
    sample: Sample

    def tree(self) -> Tree:
        """The whole as nested dictionaries of plain values."""
        return dataclasses.asdict(self)

    def identity(self) -> Tree:
        """The settings that say which experiment this is: all but the accelerator, on which it may go on elsewhere."""
        tree = self.tree()
        del tree["train"]["accelerator"]
        return tree

    def sha(self) -> str:
        """A fingerprint of `identity`, 16 hexadecimal digits."""
        return hashlib.sha256(yaml.safe_dump(self.identity()).encode()).hexdigest()[:16]


def names(axis: str) -> list[str]:
    """The ablations or presets that exist: the files under conf/<axis>/."""
    return sorted(file.stem for file in (CONF / axis).glob("*.yaml"))


def load(arguments: Sequence[str] = ()) -> Config:
    """conf/base.yaml, then the preset, then the ablation, then arguments `key=value`, checked.

    An ablation's block `times` multiplies what base and preset say, so that its lengths follow every preset.

    Raises:
        ConfigError: an unknown name, a value of the wrong type or out of range.
    """
    pairs = [split(argument) for argument in arguments]
    base = _read("base")
    chosen = {axis: str(dict(pairs).get(axis, base[axis])) for axis in ("preset", "ablation")}
    for axis, name in chosen.items():
        if name not in names(axis):
            offer = nearest(name, names(axis))
            raise ConfigError(f"{axis}={brief(name)}: expected one of {', '.join(names(axis))}{offer}")
    preset, ablation = (_read(f"{axis}/{name}") for axis, name in chosen.items())
    factors = _factors(f"conf/ablation/{chosen['ablation']}.yaml", ablation.pop("times", {}))
    settings = _schema(Config)
    for key, value in (flatten(base) | flatten(preset)).items():
        _set(settings, key, value)
    for key, factor in factors.items():
        _set(settings, key, _multiplied(key, OmegaConf.select(settings, key), factor))
    for key, value in [*flatten(ablation).items(), *pairs]:
        _set(settings, key, value)
    return from_tree(OmegaConf.to_container(settings))


def _factors(file: str, times: Any) -> dict[str, float]:
    """What an ablation's block `times` multiplies, by the setting's dotted key.

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
    settings = _schema(Config)
    for key, value in flatten(tree).items():
        _set(settings, key, value)
    missing = sorted(OmegaConf.missing_keys(settings))
    if missing:
        raise ConfigError(f"{missing[0]}: expected a value, found none")
    config = OmegaConf.to_object(settings)
    assert isinstance(config, Config)
    _check(config)
    return config


def override(config: Config, arguments: Sequence[str], allowed: Sequence[str]) -> Config:
    """The config with arguments `key=value` laid over it, of which only those that begin as allowed may come.

    Raises:
        ConfigError: as `load`; also for a key that is not allowed.
    """
    settings = _schema(Config)
    for key, value in flatten(config.tree()).items():
        _set(settings, key, value)
    for key, value in map(split, arguments):
        _set(settings, key, value)
        if not key.startswith(tuple(allowed)):
            expected = f"expected settings of {' and '.join(allowed)} only"
            raise ConfigError(f"{key}={brief(value)}: fixed by the run, {expected}")
    return from_tree(OmegaConf.to_container(settings))


def flatten(tree: Tree, prefix: str = "") -> Tree:
    """Nested settings as one dictionary with dotted keys."""
    flat: Tree = {}
    for name, value in tree.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def _fields(cls: type = Config, prefix: str = "") -> Iterator[tuple[str, Any, Range]]:
    """Every setting's dotted key, type and range."""
    for name, annotation in get_type_hints(cls, include_extras=True).items():
        kind, allowed = get_args(annotation) if get_origin(annotation) is Annotated else (annotation, Range())
        if dataclasses.is_dataclass(kind):
            yield from _fields(cast(type, kind), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", kind, RANGES.get(f"{prefix}{name}", allowed)


@functools.cache
def _types() -> dict[str, Any]:
    """Every setting's type by its dotted key."""
    return {name: kind for name, kind, _ in _fields()}


def _schema(cls: type) -> Any:
    """The typed tree with every setting missing; open for writing although the dataclasses are frozen."""
    node = OmegaConf.structured(cls)
    OmegaConf.set_readonly(node, False)
    for name, kind in get_type_hints(cls).items():
        if dataclasses.is_dataclass(kind):
            node[name] = _schema(cast(type, kind))
    return node


def _read(name: str) -> Tree:
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
    if config.data.negative_share is not None and (not config.data.negatives or config.data.repair):
        raise ConfigError(
            f"data.negative_share={config.data.negative_share}: expected data.negatives=true and data.repair=false"
        )
    if config.data.repair and not config.data.negatives:
        raise ConfigError("data.repair=True: expected data.negatives=true, there is nothing to repair in D+")
    if config.data.repair and not config.correction.margin:
        # Repair comes as near to the boundary as it wants, from within: without a margin the label would not change.
        raise ConfigError("correction.margin=0.0: expected a number above 0 where data.repair=true")
    if config.source.kind == "gaussian" and (
        config.correction.smoothing == "covariant" or config.network.kind == "spectral"
    ):
        raise ConfigError("source.kind=gaussian: expected gp or cgp where the source's covariance is asked for")
    if config.train.norm == "modes" and config.network.kind != "spectral":
        raise ConfigError("train.norm=modes: expected network.kind=spectral, which has modes")
    if config.network.sees_ends and config.network.kind == "spectral":
        raise ConfigError("network.sees_ends=True: expected network.kind=resmlp, spectral takes start and goal from x")
    if config.correction.keep_ends and config.correction.smoothing == "covariant":
        raise ConfigError("correction.keep_ends=True: expected correction.smoothing=filter, covariant always does")
    if config.source.fit and config.source.kind == "gaussian":
        raise ConfigError("source.fit=True: expected source.kind gp or cgp, the standard normal has nothing to fit")
