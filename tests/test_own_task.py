"""The README's task of one's own: trained, compared in a grid, drawn, planned with, from the shell and from Python."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
LONGEST = 60
SMALL = ("preset=smoke", "sample.num=16", "data.num=200")


def example(beginning: str) -> str:
    """The README's Python code that begins so."""
    blocks: list[str] = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (found,) = [block for block in blocks if block.startswith(beginning)]
    return found


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the README's task in a file."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_task.py").write_text(example("import torch\nimport conflow"))
    return folder


def execute(place: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    """A fresh interpreter in the folder, with the folder's own store."""
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    return subprocess.run(
        [sys.executable, *arguments], cwd=place, env=environment, capture_output=True, text=True, timeout=300
    )


def run(place: Path, *arguments: str) -> str:
    """What it prints, where it succeeds."""
    finished = execute(place, *arguments)
    assert finished.returncode == 0, finished.stdout + finished.stderr
    return finished.stdout


def test_the_example_is_short() -> None:
    assert len(example("import torch\nimport conflow").splitlines()) <= LONGEST


def test_it_is_trained_in_a_grid_and_compared(place: Path) -> None:
    """What it understood is said first; each constraint has its columns."""
    printed = run(
        place, "-m", "conflow", "ablations", "task=my_task.py", "ablations=plus fm", "seeds=0", "jobs=1", *SMALL
    )
    assert "2 cells, 0 of them finished before" in printed
    for column in ("none: corridor", "none: speed", "all: corridor", "all: speed"):
        assert column in printed
    again = run(
        place, "-m", "conflow", "ablations", "task=my_task.py", "ablations=plus fm", "seeds=0", "jobs=1", *SMALL
    )
    assert "2 cells, 2 of them finished before" in again


def test_a_changed_task_is_trained_anew(place: Path) -> None:
    """Its code decides numbers as the program's does; a comment does not."""
    file = place / "my_task.py"
    text = file.read_text()
    command = ("-m", "conflow", "ablations", "task=my_task.py", "ablations=fm", "seeds=0", "jobs=1", *SMALL)
    try:
        file.write_text(text + "# a comment\n")
        assert "1 cells, 1 of them finished before" in run(place, *command)
        file.write_text(text.replace("0.25", "0.26"))
        assert "1 cells, 0 of them finished before" in run(place, *command)
    finally:
        file.write_text(text)


def test_it_is_drawn_and_planned_with(place: Path) -> None:
    printed = run(place, "-m", "conflow", "figures", "run=my_task-plus-s0", "task=my_task.py")
    assert "animation.html" in printed
    drawn = {path.stem for path in place.glob("runs/figures/*/*.png")}
    assert {"page", "demonstrations", "sources", "clearances", "guidance", "guidance_weight"} <= drawn
    printed = run(
        place,
        *("-m", "conflow", "sample", "run=my_task-plus-s0", "task=my_task.py", "start=-9,0", "goal=9,0", "num=8"),
    )
    assert "of 8 plans are feasible" in printed
    assert (place / "plans.png").exists()


def test_a_checkpoint_does_not_name_the_code_that_is_run(place: Path) -> None:
    """A file may come from anywhere: whoever loads it brings the task."""
    command = ("-m", "conflow", "sample", "run=my_task-plus-s0", "start=-9,0", "goal=9,0", "out=other.npz")
    finished = execute(place, *command)
    assert finished.returncode == 2
    assert "expected the file or the object of task my_task, which no checkpoint holds" in finished.stderr
    assert len(finished.stderr.splitlines()) == 1


def test_the_same_from_python(place: Path) -> None:
    """The README's lines, at the size of a test; the run is the same as the shell's, so `compare` has one seed."""
    code = example("import conflow\nfrom my_task").replace('ablation="plus"', 'ablation="plus", preset="smoke"')
    code = code.replace("conflow.compare(task=task)", 'conflow.compare(task=task, preset="smoke")')
    printed = run(place, "-c", f"{code}\nprint(plans.x.shape, sorted(set(table.column)))")
    assert "torch.Size([64, 32, 2])" in printed
    assert "none: corridor" in printed
