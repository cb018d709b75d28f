"""What `pip install` leaves where there is no checkout: a wheel that runs by itself."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from mlflow import MlflowClient

from conflow import __version__
from conflow.tracking import recording
from conflow.training import config

ROOT = Path(__file__).parents[1]


def execute(*arguments: str, cwd: Path, python_path: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if key not in ("MLFLOW_TRACKING_URI", "PYTHONPATH")}
    if python_path is not None:
        environment["PYTHONPATH"] = str(python_path)
    return subprocess.run(arguments, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package as a wheel installs it, within a repository of somebody else's."""
    folder = tmp_path_factory.mktemp("elsewhere")
    author = ["-c", "user.name=somebody", "-c", "user.email=somebody@example.org"]
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    for command in (
        ["git", "init", "--quiet"],
        ["git", *author, "commit", "--quiet", "--allow-empty", "--message", "not ours"],
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)],
    ):
        assert execute(*command, cwd=folder).returncode == 0
    (wheel,) = folder.glob("*.whl")
    assert (
        execute(*pip, "install", "--no-deps", "--target", str(folder / "site"), str(wheel), cwd=folder).returncode == 0
    )
    return folder / "site"


def test_a_wheel_holds_all_that_is_read_at_run_time(installed: Path) -> None:
    """Every file of the package, and of conf/ inside the package: beside it another distribution's may be."""
    files = [path for part in ("conf", "conflow") for path in (ROOT / part).rglob("*") if path.is_file()]
    shipped = [path.relative_to(ROOT) for path in files if path.suffix != ".pyc"]
    assert {Path("conf/base.yaml"), Path("conflow/figures/animation.html")} <= set(shipped)
    for name in shipped:
        there = installed / ("conflow" if name.parts[0] == "conf" else "") / name
        assert there.read_bytes() == (ROOT / name).read_bytes()
    assert sorted(path.name.split("-")[0] for path in installed.iterdir()) == ["bin", "conflow", "conflow"]


def test_a_checkout_says_its_revision() -> None:
    head = execute("git", "rev-parse", "HEAD", cwd=ROOT).stdout.strip()
    assert recording.origin()["git_sha"] == (head or "unknown")


def test_an_installed_package_trains_in_an_empty_folder(installed: Path, tmp_path: Path) -> None:
    finished = execute(sys.executable, "-m", "conflow", "train", "preset=smoke", cwd=tmp_path, python_path=installed)
    assert finished.returncode == 0, finished.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    store = MlflowClient(f"sqlite:///{tmp_path / 'runs' / 'mlflow.db'}")
    experiment = store.get_experiment_by_name("conflow")
    assert experiment is not None
    (made,) = store.search_runs([experiment.experiment_id])
    assert (made.info.status, made.data.tags["config_sha"]) == ("FINISHED", config.load(["preset=smoke"]).sha())
    # Neither the revision of the repository that the package happens to lie in, nor this one's.
    assert (made.data.tags["git_sha"], made.data.tags["git_dirty"]) == ("unknown", "unknown")
    assert f"conflow {__version__}" in made.data.tags["versions"]
