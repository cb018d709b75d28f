"""Which part imports which: downwards only, and nothing heavy before it is needed."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import conflow
from conflow.training import config
from tests.papers import model_of

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


def loaded(*arguments: str, code: int = 0) -> set[str]:
    """The modules that a fresh interpreter has imported when it has run `arguments` and ended with this code."""
    finished = subprocess.run(
        [sys.executable, "-X", "importtime", *arguments], capture_output=True, text=True, timeout=60
    )
    assert finished.returncode == code, finished.stderr
    return {line.rpartition("|")[2].strip() for line in finished.stderr.splitlines() if line.startswith("import time:")}


@pytest.mark.parametrize("module", FILES)
def test_imports_go_downwards_only(module: str) -> None:
    """A room knows itself and those below it; flow/ and scene/, at the bottom, and tracking/ know no other room."""
    training = {"errors", "flow", "scene", "tracking", "training"}
    results = {*training, "results"}
    figures = {*results, "figures"}
    commands = {"commandline", "demonstrations", "planbench", "sample"}
    below = {
        "errors": set(),
        "flow": {"flow"},
        "scene": {"scene"},
        "tracking": {"errors", "tracking"},
        "recordings": {"errors", "recordings"},
        "training": training,
        "results": results,
        "planner": training,
        # Among the pictures is one of plans; nothing else there knows the planner.
        "figures": {*figures, "planner"} if module == "conflow.figures.plans" else figures,
        "grid": {*training, "grid"},
        "commandline": {"errors", "training"},
        "demonstrations": {"errors", "scene", "recordings", "training", "commandline"},
        "sample": {"errors", "scene", "training", "commandline", "planner", "figures"},
        "orca": {"scene"},
        "planbench": {*figures, "commandline", "orca", "planner"},
        "api": figures,
        "__main__": {*figures, "grid", *commands},
        # The package itself names what programs need, and imports it when they ask for it.
        "": {"api", "planner", "scene"},
    }
    ours = {part(name) for name in imports(module) if name.split(".")[0] == "conflow"} - {""}
    assert ours <= below[part(module)]


def test_ray_is_imported_by_the_grid_on_a_cluster_alone() -> None:
    """It is an extra, and the one command that trains on a cluster imports what imports it, when it is asked to."""
    assert {module for module in FILES if "ray" in {name.split(".")[0] for name in imports(module)}} == {
        "conflow.grid.cluster"
    }
    assert {module for module in FILES if "conflow.grid.cluster" in imports(module)} == {"conflow.__main__"}
    assert "conflow.grid.cluster" not in loaded("-c", "import conflow.__main__, conflow.grid.local")


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


def test_a_mistyped_setting_is_answered_without_torch() -> None:
    """In a fraction of a second, where torch and Lightning would take several."""
    seen = loaded("-m", "conflow", "train", "ablatoin=cgp", code=2)
    assert "omegaconf" in seen
    assert not {"torch", "lightning", "mlflow", "numpy"} & {name.split(".")[0] for name in seen}


TOOLS = {
    *("lightning", "pytorch_lightning", "mlflow", "sqlalchemy", "omegaconf", "yaml", "scipy", "matplotlib"),
    *("torchmetrics", "pandas", "rich"),
}


def test_the_planner_needs_torch_and_numpy_alone(tmp_path: Path) -> None:
    """Also where it reads a model's file and plans: a robot's computer has none of the experiment's tools."""
    assert not TOOLS & {name.split(".")[0] for name in loaded("-c", "import conflow.planner")}
    flow = model_of(config.load(["preset=smoke"]))
    checkpoint = {"state_dict": flow.state_dict()}
    flow.on_save_checkpoint(checkpoint)
    torch.save(checkpoint, tmp_path / "model.ckpt")
    program = """
import sys
import conflow
planner = conflow.Planner.load(sys.argv[1])
ends = (-0.8, 0, 0.8, 0), (0.8, 0, -0.8, 0)
assert planner.plan(*ends, 3, obstacles=[(0, 0.5, 0.1)], via=[(0.5, (0, -0.4, 0, 0.1))]).x.shape == (3, 32, 4)
"""
    seen = {name.split(".")[0] for name in loaded("-c", program, str(tmp_path / "model.ckpt"))}
    assert {"torch", "numpy"} <= seen
    assert not TOOLS & seen
