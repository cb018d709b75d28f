import importlib.util
import json
import os
import pwd
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from mlflow import MlflowClient
from mlflow.entities import Run

from tests.faults.test_concurrency import (
    LEFT,
    TINY,
    assert_complete,
    make_together,
    started,
    stopped_afterwards,
    wait_for,
)
from tests.test_ui import free_port

# Where Debian keeps them, and what the PATH finds.
FOLDERS = os.pathsep.join([os.environ.get("PATH", ""), *map(str, Path("/usr/lib/postgresql").glob("*/bin"))])


def user() -> str | None:
    """Whom PostgreSQL runs as: it refuses root."""
    if os.geteuid() != 0:
        return pwd.getpwuid(os.geteuid()).pw_name
    known = {entry.pw_name for entry in pwd.getpwall()}
    return next((name for name in ("postgres", "nobody") if name in known), None)


MISSING = [name for name in ("initdb", "postgres", "pg_isready") if shutil.which(name, path=FOLDERS) is None]
MISSING += [] if importlib.util.find_spec("psycopg2") else ["psycopg2"]
MISSING += [] if user() else ["a user other than root"]
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"no PostgreSQL to test against, missing: {', '.join(MISSING)}")


@pytest.fixture(scope="module")
def database() -> Iterator[str]:
    """The address of an empty PostgreSQL database, on a socket in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="postgresql") as folder, Path(folder, "log").open("w") as log:
        owner = user()
        assert owner is not None
        shutil.chown(folder, owner)

        def begin(*command: str) -> "subprocess.Popen[str]":
            environment = {"PATH": FOLDERS, "LC_ALL": "C"}
            return subprocess.Popen(
                command, cwd=folder, env=environment, user=owner, text=True, stdout=log, stderr=subprocess.STDOUT
            )

        made = begin("initdb", "--pgdata=data", "--username=conflow", "--auth=trust", "--encoding=UTF8", "--no-sync")
        assert made.wait(timeout=120) == 0, Path(log.name).read_text()
        with stopped_afterwards(begin("postgres", "-D", "data", "-k", folder, "-c", "listen_addresses=", "-F")):
            deadline = time.monotonic() + 60
            while begin("pg_isready", "--host", folder).wait(timeout=30) != 0:
                assert time.monotonic() < deadline, Path(log.name).read_text()
                time.sleep(0.2)
            yield f"postgresql+psycopg2://conflow@/postgres?host={folder}"


@dataclass(frozen=True)
class Server:
    """An MLflow server.

    Attributes:
        uri: what MLFLOW_TRACKING_URI is set to.
        artifacts: the folder where it keeps them.
    """

    uri: str
    artifacts: Path

    def runs(self, name: str) -> list[Run]:
        client = MlflowClient(self.uri)
        experiment = client.get_experiment_by_name("conflow")
        condition = f"attributes.run_name = '{name}'"
        return list(client.search_runs([experiment.experiment_id], condition)) if experiment else []

    def kept(self, run: Run) -> Path:
        """Where a run's artifacts are, which a client knows by an address of the server's alone."""
        scheme, _, path = str(run.info.artifact_uri).partition(":/")
        assert scheme == "mlflow-artifacts"
        return self.artifacts / path


@contextmanager
def serving(database: str, folder: Path, address: str = "127.0.0.1") -> Iterator[Server]:
    """An MLflow server on the database, in a folder of its own."""
    port = free_port()
    command = [sys.executable, "-m", "mlflow", "server", "--backend-store-uri", database, "--workers", "1"]
    command += ["--artifacts-destination", str(folder / "artifacts"), "--host", address, "--port", str(port)]
    quick = {"MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=folder, env=os.environ | quick, text=True, stdout=log, stderr=subprocess.STDOUT
        )
    with stopped_afterwards(process):
        wait_for(f"http://{address}:{port}", process)
        yield Server(f"http://{address}:{port}", folder / "artifacts")


@pytest.fixture(scope="module")
def server(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with serving(database, tmp_path_factory.mktemp("server")) as server:
        yield server


@pytest.fixture(scope="module")
def machines(server: Server, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two folders that know nothing of each other, in each of which a training on the empty store has ended."""
    folders = tmp_path_factory.mktemp("one"), tmp_path_factory.mktemp("other")
    trainings = [started(folder, "train", *TINY, f"seed={seed}", uri=server.uri) for seed, folder in enumerate(folders)]
    with stopped_afterwards(*trainings):
        outputs = [training.communicate(timeout=300)[0] for training in trainings]
    assert [training.returncode for training in trainings] == [0, 0], "\n".join(outputs)
    return folders


def ended(folder: Path, server: Server, *arguments: str) -> str:
    """What a command prints that ends well."""
    command = started(folder, *arguments, uri=server.uri)
    with stopped_afterwards(command):
        output, _ = command.communicate(timeout=300)
    assert command.returncode == 0, output
    return output


def test_two_machines_train_at_once_on_a_server_and_keep_nothing_of_it(
    machines: tuple[Path, Path], server: Server
) -> None:
    for seed, folder in enumerate(machines):
        (run,) = server.runs(f"cgp-s{seed}")
        history = MlflowClient(server.uri).get_metric_history(run.info.run_id, "train/loss")
        assert_complete(run, [metric.step for metric in history])
        assert {name for name in LEFT if (server.kept(run) / name).stat().st_size > 0} == LEFT
        assert [path.name for path in folder.iterdir()] == ["runs"]
        assert not {"mlflow.db", "artifacts"} & {path.name for path in (folder / "runs").iterdir()}


def test_machines_that_make_the_same_at_the_same_moment_do_not_fail_each_other(
    server: Server, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """The same is the experiment, and five new data sets."""
    make_together([tmp_path_factory.mktemp("machine") for _ in range(3)], "made at once", server.uri)


def test_a_third_machine_compares_what_the_two_have_trained(
    machines: tuple[Path, Path], server: Server, tmp_path: Path
) -> None:
    output = ended(tmp_path, server, "compare", *TINY, "format=json")
    cells = [cell for cell in json.loads(output)["cells"] if cell["table"] == "1"]
    assert {cell["seeds"] for cell in cells if cell["row"].startswith("ConFlow (D+ and D-), ")} == {2}


def test_a_third_machine_evaluates_and_draws_a_run_and_the_server_keeps_it(
    machines: tuple[Path, Path], server: Server, tmp_path: Path
) -> None:
    ended(tmp_path, server, "evaluate", "run=cgp-s0", "sample.steps=3")
    ended(tmp_path, server, "figures", "run=cgp-s0")
    (run,) = server.runs("cgp-s0")
    assert "evaluate/val sample.steps:3/none/robot_collision_rate" in run.data.metrics
    assert (server.kept(run) / "evaluate" / "val sample.steps:3.yaml").exists()
    assert (server.kept(run) / "figures" / "guidance.png").read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "runs" / "mlflow.db").exists()


def test_the_pages_of_a_store_on_a_server_are_those_of_the_server(
    machines: tuple[Path, Path], server: Server, tmp_path: Path
) -> None:
    assert ended(tmp_path, server, "ui").startswith(f"{server.uri}/#/experiments/")


def test_a_training_interrupted_on_a_server_is_killed_there(server: Server, tmp_path: Path) -> None:
    endless = ["train.max_steps=1000000", "train.val_every=1000000", "train.log_every=50"]
    training = started(tmp_path, "train", *TINY, *endless, "seed=5", uri=server.uri)
    with stopped_afterwards(training):
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline and training.poll() is None:
            if any("train/loss" in run.data.metrics for run in server.runs("cgp-s5")):
                break
            time.sleep(0.5)
        training.send_signal(signal.SIGTERM)
        output, _ = training.communicate(timeout=180)
    assert training.returncode == 128 + signal.SIGTERM, output
    assert output.splitlines()[-1] == "conflow: interrupted by SIGTERM"
    (run,) = server.runs("cgp-s5")
    assert run.info.status == "KILLED"
    assert run.data.metrics["train/loss"] > 0
