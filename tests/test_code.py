"""What belongs to the identity of a run: the code that trains and measures, as far as it is executed."""

import ast
import shutil
from pathlib import Path

import pytest

from conflow.tracking import code
from tests.test_layout import imports

CORRECTION = "flow/correction.py"
OWN = code.files()


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the program's code."""
    return Path(shutil.copytree(code.PACKAGE, tmp_path / "conflow"))


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


def changed(package: Path) -> set[str]:
    """The files of a package whose digest is not the program's own."""
    edited = code.files.__wrapped__(package)
    return {name for name in OWN.keys() | edited.keys() if OWN.get(name) != edited.get(name)}


def test_a_flipped_sign_shows_and_a_copy_does_not(package: Path) -> None:
    assert changed(package) == set()
    edit(package / CORRECTION, "return along(self", "return -along(self")
    assert changed(package) == {CORRECTION}


def test_a_new_file_of_the_method_and_one_that_is_gone_show(package: Path) -> None:
    (package / "flow" / "better.py").write_text("x = 1\n")
    (package / "scene" / "robots.py").unlink()
    assert changed(package) == {"flow/better.py", "scene/robots.py"}


def test_what_is_not_executed_does_not_show(package: Path) -> None:
    """Comments, layout, docstrings, annotations, and files that only read or store a run."""
    for path in package.rglob("*.py"):
        path.write_text(f"# A comment.\n\n{path.read_text()}\n\n")
    edit(package / CORRECTION, '"""', '"""Otherwise said. ')
    edit(package / "training" / "evaluation.py", "LATENCY_BATCH = 256\n", 'LATENCY_BATCH = 256\n"""Of latency."""\n')
    edit(package / "training" / "metrics.py", "-> Tensor", '-> "Tensor"')
    edit(package / "figures" / "workspace.py", "import", "import this\nimport")
    edit(package / "tracking" / "recording.py", "FLUSH_SECONDS = 5.0", "FLUSH_SECONDS = 6.0")
    assert changed(package) == set()


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("x = -y", "x = y"),
        ("x = 1", "x = 1.0"),
        ("x = None", "x = ..."),
        ("f(a, b)", "f(b, a)"),
        ("f(a=b)", "f(**b)"),
        ("x[1:]", "x[:1]"),
        ("x[1:]", "x[::1]"),
        ("class A:\n    x: int\n    y: int", "class A:\n    y: int\n    x: int"),
        ("def f(x, *, y): pass", "def f(x, y): pass"),
        ("if a:\n    b()\nc()", "if a:\n    b()\n    c()"),
    ],
)
def test_what_acts_otherwise_is_told_apart(one: str, other: str) -> None:
    assert code.executed(ast.parse(one)) != code.executed(ast.parse(other))


def test_nothing_that_is_empty_is_part_of_it() -> None:
    """In that alone the syntax trees of Python's versions differ; written out, since a test runs on one of them."""
    tree = ast.parse("def f(x: int) -> int:\n    '''Text.'''\n    return x")
    assert code.executed(tree) == (
        "Module(body=[FunctionDef(name='f', args=arguments(args=[arg(arg='x')]), "
        "body=[Return(value=Name(id='x', ctx=Load()))])])"
    )


def test_what_trains_and_measures_uses_nothing_of_ours_that_is_left_out() -> None:
    """But the settings, which are compared by value, what refuses them, and the display. train.py stores as well."""
    inner = [name for name in code.files() if name != "training/train.py"]
    modules = {f"conflow.{name.removesuffix('.py').replace('/', '.')}".removesuffix(".__init__") for name in inner}
    used = {name for module in modules for name in imports(module) if name.startswith("conflow")}
    assert used - modules == {
        "conflow.errors",
        "conflow.training.config",
        "conflow.training.memory",
        "conflow.training.progress",
    }


def test_a_users_file_counts_as_far_as_it_is_executed(tmp_path: Path) -> None:
    """One that cannot be parsed by its text, and one that is gone by nothing."""
    file, digests = tmp_path / "task.py", []
    for text in ("x = 1\n", "# A comment.\nx = 1  # and another\n", "x = 2\n", "x = (\n", "x = ( \n"):
        file.write_text(text)
        digests.append(code.of_file(file))
    assert digests[0] == digests[1]
    assert len(set(digests)) == 4
    assert all(len(digest) == 8 for digest in digests)
    file.unlink()
    assert code.of_file(file) == "none"


def test_a_run_knows_the_files_in_which_the_present_code_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    tags = code.tags()
    assert len(tags["code_sha"]) == 16
    assert len(tags["code"]) < 5000, "MLflow's limit"
    assert code.differing(tags) == []
    assert code.differing({}) == [code.UNKNOWN]
    monkeypatch.setattr(code, "files", lambda: dict(OWN) | {CORRECTION: "00000000"})
    assert code.differing(tags) == [CORRECTION]
    assert code.tags()["code_sha"] != tags["code_sha"]


def test_a_run_that_other_code_went_on_with_is_of_neither(monkeypatch: pytest.MonkeyPatch) -> None:
    first = code.tags()
    assert code.tags_after(first) == first
    assert code.tags_after({}) == {}, "what is unknown of its beginning stays unknown"
    monkeypatch.setattr(code, "files", lambda: dict(OWN) | {CORRECTION: "00000000"})
    both = code.tags_after(first)
    assert f"{CORRECTION}:{OWN[CORRECTION]}+00000000" in both["code"].split()
    assert code.differing(both) == [CORRECTION]
    assert code.tags_after(both) == both
    monkeypatch.undo()
    assert code.differing(both) == [CORRECTION]
    assert both["code_sha"] != first["code_sha"]
