"""Two hosts with nothing in common but an MLflow server, and a network between them that is cut."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from mlflow import MlflowClient
from mlflow.entities import Run

import conflow
from conflow.tracking import carried, checkpoints, liveness
from tests.faults import test_postgresql
from tests.faults.hosts import Host, connected
from tests.faults.test_concurrency import stopped_afterwards
from tests.faults.test_postgresql import Server, serving

pytestmark = test_postgresql.pytestmark
database = test_postgresql.database

TRAIN = (
    *("train", "preset=smoke", "data.num=200", "train.max_steps=41", "train.val_every=10", "train.log_every=7"),
    *("train.batch_size=16", "sample.num=8", "sample.steps=3"),
)
# The command line of a program that writes and carries often, and waits for the test in the middle of its training.
PROGRAM = """
import sys, time
from pathlib import Path
from conflow.tracking import carried, liveness, recording
from conflow.training.module import Training

recording.FLUSH_SECONDS = carried.SECONDS = 0.0
liveness.BEAT, liveness.EXPIRY = 0.5, float(sys.argv.pop(1))
step, original = 0, Training.training_step

def training_step(self, *arguments):
    global step
    step += 1
    if step == 25 and Path("waits").exists():
        Path("waiting").touch()
        while Path("waits").exists():
            time.sleep(0.1)
    return original(self, *arguments)

Training.training_step = training_step
from conflow.__main__ import main
main()
"""


@pytest.fixture(scope="module")
def network(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, tuple[Host, ...]]]:
    with (
        connected("alpha", "beta") as (address, hosts),
        serving(database, tmp_path_factory.mktemp("server"), address) as server,
    ):
        yield server, hosts


def history(server: Server, run: Run) -> dict[str, list[tuple[int, float]]]:
    """Every metric's steps and values, a point that was written twice twice, but for those that are times."""
    client = MlflowClient(server.uri)
    return {
        key: sorted((point.step, point.value) for point in client.get_metric_history(run.info.run_id, key))
        for key in run.data.metrics
        if not key.endswith(("steps_per_second", "train/seconds", "latency_ms"))
    }


def weights(server: Server, run: Run) -> dict[str, torch.Tensor]:
    state: dict[str, torch.Tensor] = torch.load(server.kept(run) / "model.ckpt", weights_only=True)["state_dict"]
    return state


@pytest.fixture(scope="module")
def whole(network: tuple[Server, tuple[Host, ...]], tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run that nothing disturbs."""
    server, (alpha, _) = network
    folder = tmp_path_factory.mktemp("whole")
    with stopped_afterwards(process := started(alpha, folder, server, 600)):
        assert process.wait(300) == 0, (folder / "output").read_text()
    (run,) = server.runs("cgp-s0")
    MlflowClient(server.uri).set_tag(run.info.run_id, "mlflow.runName", "whole")
    return run


def started(
    host: Host, folder: Path, server: Server, expiry: float, *arguments: str, **variables: str
) -> "subprocess.Popen[str]":
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(conflow.__file__).parents[1]),
        "MLFLOW_TRACKING_URI": server.uri,
        carried.ASKED: "1",
        **variables,
    }
    command = [sys.executable, "-c", PROGRAM, str(expiry), *TRAIN, *arguments]
    return host.start(folder, *command, environment=environment, output="output")


@pytest.mark.parametrize(("seen_dead", "link"), [("by the engine's task", "is mended"), ("by its beats", "stays cut")])
def test_of_a_run_behind_a_cut_link_another_host_makes_the_undisturbed_one(
    seen_dead: str,
    link: str,
    network: tuple[Server, tuple[Host, ...]],
    whole: Run,
    tmp_path: Path,
) -> None:
    """The old attempt ends itself, whether it cannot write or would write what the new one has written."""
    server, (alpha, beta) = network
    client = MlflowClient(server.uri)
    task = {liveness.ENGINE_TASK: f"task {tmp_path}"} if seen_dead == "by the engine's task" else {}
    expiry = 600.0 if task else 6.0
    here, there = tmp_path / "alpha", tmp_path / "beta"
    for folder in (here, there):
        folder.mkdir()
    (here / "waits").touch()
    impatient = {"MLFLOW_HTTP_REQUEST_TIMEOUT": "1", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1"}
    old = started(alpha, here, server, expiry, **task, **impatient)
    with stopped_afterwards(old):
        deadline = time.monotonic() + 180
        while not (here / "waiting").exists():
            assert time.monotonic() < deadline, (here / "output").read_text()
            assert old.poll() is None, (here / "output").read_text()
            time.sleep(0.2)
        run = server.runs("cgp-s0")[0]
        assert run.info.status == "RUNNING"
        assert run.data.tags["host"] == "alpha"
        alpha.cut()
        try:
            if not task:
                time.sleep(expiry + 1)
            if link == "stays cut":
                (here / "waits").unlink()
                assert old.wait(120) != 0
            new = started(beta, there, server, 600, "resume=cgp-s0", **task)
            with stopped_afterwards(new):
                assert new.wait(300) == 0, (there / "output").read_text()
        finally:
            alpha.mend()
        if link == "is mended":
            (here / "waits").unlink()
            assert old.wait(120) == 2
            assert "found that beta goes on with it" in (here / "output").read_text()
    run = client.get_run(run.info.run_id)
    assert "from step 20 of 41" in (there / "output").read_text()
    assert run.info.status == "FINISHED"
    assert (run.data.tags["resumed"], run.data.tags["hosts"]) == ("1", "alpha; beta")
    assert all(torch.equal(tensor, weights(server, whole)[name]) for name, tensor in weights(server, run).items())
    assert history(server, run) == history(server, whole)
    assert (here / "runs" / "checkpoints" / run.info.run_id / checkpoints.LAST).exists(), "which beta could not see"
    assert not client.list_artifacts(run.info.run_id, carried.FOLDER), "a finished run needs it no more"
    client.set_tag(run.info.run_id, "mlflow.runName", "done")
