"""What a user did that cannot be used, in one line."""

import difflib
from collections.abc import Sequence


class ConfigError(ValueError):
    """A setting that cannot be used: its name, its value and what was expected, in one line."""

    def __init__(self, reason: str) -> None:
        super().__init__(" ".join(reason.split()))


def nearest(name: str, known: Sequence[str]) -> str:
    """An offer of the known name that is most like this one, where one is."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"; did you mean {close[0]}?" if close else ""


def brief(value: object) -> str:
    """A value in one line of bearable length, as a message shows it."""
    try:
        text = " ".join(str(value).split())
    except ValueError:  # Python refuses to write out a number of more than 4,300 digits
        return "a huge number"
    return text if len(text) <= 60 else f"{text[:57]}..."
