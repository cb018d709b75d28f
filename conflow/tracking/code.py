"""Which code made a run: a fingerprint of what decides its numbers, file by file."""

import ast
import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
DECISIVE = (
    "flow/**/*.py",  # the method
    "scene/**/*.py",  # the world, and the demonstrations of it
    "training/build.py",  # what a setting's name stands for, and every random number
    "training/datamodule.py",  # labels, splits and batches
    "training/model.py",  # loss and sampling
    "training/module.py",  # and its optimiser
    "training/train.py",  # the loop, and what comes in which order
    "training/callbacks.py",  # what is measured during training
    "training/evaluation.py",  # what is sampled for validation and test
    "training/metrics.py",  # and how that is measured
    "tracking/ranks.py",  # how a batch is shared
)
"""The files under conflow/ that train and measure.

Not among them: config.py, whose settings are compared by their values; what watches and stores a run, as the rest of
tracking/; and what only reads it, as results/ and figures/.
"""
UNKNOWN = "unknown files"
UNEXECUTED = ("annotation", "returns", "type_comment", "type_params")


@functools.cache
def files(package: Path = PACKAGE) -> Mapping[str, str]:
    """The digest of every decisive file, 8 hexadecimal digits, by its path under conflow/.

    Read once: what a long command does is decided by the code that it began with.
    """
    paths = sorted(path for pattern in DECISIVE for path in package.glob(pattern))
    return {path.relative_to(package).as_posix(): _sha(executed(ast.parse(path.read_bytes())))[:8] for path in paths}


def of_file(path: Path) -> str:
    """The digest of one more file that decides numbers, such as a user's task; of a broken one, of its text."""
    try:
        content = path.read_bytes()
    except OSError:
        return "none"
    try:
        return _sha(executed(ast.parse(content)))[:8]
    except (SyntaxError, ValueError):
        return hashlib.sha256(content).hexdigest()[:8]


def executed(node: object) -> str:
    """A syntax tree as text, without comments, layout, docstrings and annotations.

    Unlike `ast.dump` it leaves out all that is empty, so that every version of Python writes the same.
    """
    if isinstance(node, list):
        return f"[{', '.join(executed(item) for item in node if not _is_docstring(item))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = [
        f"{name}={executed(value)}"
        for name, value in ast.iter_fields(node)
        if name not in UNEXECUTED and value is not None and value != []
    ]
    return f"{type(node).__name__}({', '.join(fields)})"


def _is_docstring(node: object) -> bool:
    """Whether a statement is a text alone, at the head of a body or below what it describes."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def tags() -> dict[str, str]:
    """What a run keeps of the present code: the digest of each file, and of all of them."""
    return _tags(files())


def tags_after(tags: Mapping[str, str]) -> dict[str, str]:
    """What a run with these tags keeps when the present code goes on with it: of a file that differs both digests.

    Such a run is of neither code, and of a run of unknown code all stays unknown.
    """
    if "code" not in tags:
        return {}
    own, present = _read(tags), files()
    names = sorted(own.keys() | present.keys())
    both = {name: [*own.get(name, "none").split("+"), present.get(name, "none")] for name in names}
    return _tags({name: "+".join(dict.fromkeys(digests)) for name, digests in both.items()})


def differing(tags: Mapping[str, str]) -> list[str]:
    """The files in which the code of a run with these tags is not the present one; `UNKNOWN` where it kept none."""
    if "code" not in tags:
        return [UNKNOWN]
    own, present = _read(tags), files()
    return sorted(name for name in own.keys() | present.keys() if own.get(name) != present.get(name))


def _tags(digests: Mapping[str, str]) -> dict[str, str]:
    pairs = " ".join(f"{name}:{digest}" for name, digest in digests.items())
    return {"code_sha": _sha(pairs)[:16], "code": pairs}


def _read(tags: Mapping[str, str]) -> dict[str, str]:
    return {name: digest for name, _, digest in (pair.rpartition(":") for pair in tags["code"].split())}


def _sha(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
