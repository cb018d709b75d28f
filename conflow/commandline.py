"""The options of commands: arguments `key=value` beside the settings of an experiment."""

import math
from collections.abc import Mapping, Sequence

from conflow.errors import ConfigError, brief, nearest
from conflow.training.config import SPLITS, SplitName, Tree, split


def options(arguments: Sequence[str], defaults: Mapping[str, str], settings: bool = True) -> tuple[Tree, list[str]]:
    """A command's own options out of its arguments `key=value`, and the other arguments, which are settings.

    Raises:
        ConfigError: an argument that is not of that form, or, where the command takes no settings, not an option.
    """
    chosen, rest = dict(defaults), []
    for argument in arguments:
        key, value = split(argument)
        if key in chosen:
            chosen[key] = value
        elif settings:
            rest.append(argument)
        else:
            offer = nearest(key, list(chosen))
            raise ConfigError(f"{brief(key)}: no such option, expected {', '.join(chosen)}{offer}")
    return chosen, rest


def repeated(arguments: Sequence[str], name: str) -> list[str]:
    """All values of an option that may be given several times."""
    return [value for key, value in map(split, arguments) if key == name and value]


def number(options: Mapping[str, str], key: str) -> float:
    """An option that is a finite number.

    Raises:
        ConfigError: it is not.
    """
    try:
        value = float(options[key])
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ConfigError(f"{key}={brief(options[key])}: expected a finite number")
    return value


def whole(options: Mapping[str, str], key: str, low: int, high: int) -> int:
    """An option that is a whole number in [low, high].

    Raises:
        ConfigError: it is not.
    """
    text = options[key]
    # Longer numbers than Python converts are too large anyway.
    if not text.isdecimal() or len(text) > 99 or not low <= int(text) <= high:
        raise ConfigError(f"{key}={brief(text)}: expected a whole number of at least {low} and at most {high}")
    return int(text)


def held_out(options: Mapping[str, str]) -> SplitName:
    """The option `split`.

    Raises:
        ConfigError: it names none that is held out.
    """
    for name in SPLITS:
        if options["split"] == name:
            return name
    raise ConfigError(f"split={brief(options['split'])}: expected {' or '.join(SPLITS)}")
