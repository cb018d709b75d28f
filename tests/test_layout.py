"""Which part imports which: downwards only, and nothing heavy before it is needed."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import conflow

PACKAGE = Path(conflow.__file__).parent
FILES = {
    ".".join(("conflow", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}


def part(module: str) -> str:
    """The room or the file under conflow/ that a module belongs to; the package itself is ''."""
    return [*module.split("."), ""][1]


def imports(module: str) -> set[str]:
    """All modules that a module's source imports anywhere, `from package import submodule` resolved."""
    found = set()
    package = module.split(".") if FILES[module].name == "__init__.py" else module.split(".")[:-1]
    for node in ast.walk(ast.parse(FILES[module].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) + 1 - node.level] if node.level else []
            origin = ".".join([*base, *([node.module] if node.module else [])])
            submodules = {f"{origin}.{alias.name}" for alias in node.names} & FILES.keys()
            found |= submodules or {origin}
    return found


def loaded(*arguments: str) -> set[str]:
    """The modules that a fresh interpreter has imported when it has run `arguments`."""
    finished = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments], capture_output=True, text=True, check=True, timeout=60
    )
    return {line.rpartition("|")[2].strip() for line in finished.stderr.splitlines() if line.startswith("import time:")}


@pytest.mark.parametrize("module", FILES)
def test_imports_go_downwards_only(module: str) -> None:
    """A room knows itself and those below it; flow/ and scene/, at the bottom, and tracking/ know no other room."""
    training = {"errors", "flow", "scene", "tracking", "training"}
    results = {*training, "results"}
    commands = {"commandline", "demonstrations", "sample", "api", "planner"}
    everything = {*results, "figures", "grid", *commands}
    below = {
        "errors": set(),
        "flow": {"flow"},
        "scene": {"scene"},
        "tracking": {"errors", "tracking"},
        "training": training,
        "results": results,
        "planner": training,
        # Among the pictures is one of plans.
        "figures": {*results, "planner", "figures"},
        "grid": {*results, "grid"},
        "commandline": training,
        "demonstrations": {*training, "commandline"},
        "sample": {*training, "commandline", "planner", "figures"},
        "api": {*results, "figures"},
        "__main__": everything,
        # The package itself names what programs need, and imports it when they ask for it.
        "": {"api", "planner", "scene"},
    }
    ours = {part(name) for name in imports(module) if name.split(".")[0] == "conflow"} - {""}
    assert ours <= below.get(part(module), set())


@pytest.mark.parametrize(("room", "libraries"), [("flow", {"torch"}), ("scene", {"torch", "numpy"})])
def test_the_method_and_the_world_stand_on_torch(room: str, libraries: set[str]) -> None:
    """Beside the standard library flow/ imports torch, and scene/, which reads files, NumPy too."""
    modules = [module for module in FILES if part(module) == room]
    assert len(modules) > 2
    imported = {name.split(".")[0] for module in modules for name in imports(module)}
    assert imported - sys.stdlib_module_names - {"conflow"} == libraries


def test_the_method_and_the_world_load_without_lightning_and_mlflow() -> None:
    """A program that imports all of flow/ and scene/ pays for torch, not for the experiment's tools."""
    modules = [module for module in FILES if part(module) in ("flow", "scene")]
    seen = loaded("-c", f"import {', '.join(modules)}")
    assert {"torch", *modules} <= seen
    tools = {"lightning", "pytorch_lightning", "mlflow", "omegaconf", "matplotlib", "torchmetrics"}
    assert not tools & {name.split(".")[0] for name in seen}


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"]])
def test_help_answers_without_torch_and_mlflow(arguments: list[str]) -> None:
    """The command line's help does not wait for libraries that it does not use."""
    seen = loaded("-m", "conflow", *arguments)
    assert "argparse" in seen
    assert not {"torch", "lightning", "mlflow", "numpy"} & {name.split(".")[0] for name in seen}
