"""A grid on a Ray cluster of hosts with nothing in common but an MLflow server: the link of one is cut."""

import os
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest
import torch
from mlflow import MlflowClient

import conflow
from conflow.tracking import carried
from tests.faults import processes, test_postgresql
from tests.faults.hosts import Host, connected
from tests.faults.test_concurrency import stopped_afterwards
from tests.faults.test_hosts import history, weights
from tests.faults.test_postgresql import Server, serving

pytest.importorskip("ray", reason="no Ray to test with, missing: the extra cluster")
pytestmark = test_postgresql.pytestmark
database = test_postgresql.database

TRAIN = ("preset=smoke", "data.num=200", "train.max_steps=3000", "train.val_every=500", "train.batch_size=16")
SMALL = ("sample.num=8", "sample.steps=3")
PORT = 6379
RAY = (sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--object-store-memory=100000000")
# The head takes a host for dead after some 15 seconds of silence; a busy one may take three for an answer. Whoever else
# waits for an answer, as the grid does, gives up by keepalives: with Ray's own of minutes it waited for more than six.
VARIABLES = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_AUTH_MODE": "token",
    "RAY_health_check_initial_delay_ms": "0",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "3000",
    "RAY_health_check_failure_threshold": "5",
    "RAY_grpc_client_keepalive_time_ms": "5000",
    "RAY_grpc_client_keepalive_timeout_ms": "10000",
    "RAY_grpc_keepalive_time_ms": "5000",
    "RAY_grpc_keepalive_timeout_ms": "10000",
    "RAY_gcs_rpc_server_reconnect_timeout_s": "20",
    "PYTHONUNBUFFERED": "1",
}
IMPATIENT = {"MLFLOW_HTTP_REQUEST_TIMEOUT": "2", "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1"}


def variables(folder: Path) -> dict[str, str]:
    """Those of all hosts, with what the cluster's own know each other by."""
    (folder / "token").write_text(uuid.uuid4().hex)
    kept = {key: value for key, value in os.environ.items() if not key.startswith(("RAY_", "MLFLOW_TRACKING_URI"))}
    own = {"RAY_AUTH_TOKEN_PATH": str(folder / "token"), "PYTHONPATH": str(Path(conflow.__file__).parents[1])}
    return kept | VARIABLES | own


@contextmanager
def cluster(hosts: tuple[Host, ...], grid: Path, environment: dict[str, str]) -> Iterator[None]:
    """A head, on the first host, that trains nothing, and others for a cell each, which do not see its folder."""
    head = hosts[0]
    with tempfile.TemporaryDirectory(prefix="ray") as name, ExitStack() as stack:  # sockets' paths must be short
        folder = Path(name)
        for host in hosts:
            own = folder / host.name
            own.mkdir()
            command = [*RAY, f"--node-ip-address={host.address}"]
            if host is head:
                command += ["--head", f"--port={PORT}", "--num-cpus=0", "--include-dashboard=false"]
                command += [f"--temp-dir={folder / 'ray'}"]
            else:
                hidden = ["sh", "-c", f'mount -t tmpfs none {grid} && exec "$@"', "sh"]
                command = [*hidden, *command, f"--address={head.address}:{PORT}", "--num-cpus=1"]
            process = host.start(own, *command, environment=environment | {"TMPDIR": str(own)}, output="output")
            stack.enter_context(stopped_afterwards(process))
            wait(partial(joined, own / "output"), process, own / "output")
        yield


def joined(output: Path) -> bool:
    """Whether a host says that it is of the cluster."""
    return "Ray runtime started" in output.read_text()


def wait(happened: Callable[[], bool], process: "subprocess.Popen[str]", output: Path, seconds: float = 240) -> None:
    """Until something has happened, while a process runs."""
    deadline = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < deadline, output.read_text()
        assert process.poll() is None, output.read_text()
        time.sleep(0.3)


def carries(server: Server, name: str) -> bool:
    """Whether a run trains, and has a checkpoint that another host can go on from."""
    return any(MlflowClient(server.uri).list_artifacts(run.info.run_id, carried.FOLDER) for run in server.runs(name))


def test_a_cell_behind_a_cut_link_ends_there_and_another_host_makes_the_undisturbed_one(
    database: str, tmp_path: Path
) -> None:
    """Ray has it tried again, once it takes the host for dead. The link stays cut until the grid has ended."""
    alone, grid = tmp_path / "alone", tmp_path / "grid"
    for folder in (alone, grid, tmp_path / "server"):
        folder.mkdir()
    undisturbed = processes.start(alone, "train", *TRAIN, *SMALL)
    with (
        connected("alpha", "beta", "gamma") as (address, hosts),
        serving(database, tmp_path / "server", address) as server,
        cluster(hosts, grid, environment := variables(tmp_path)),
    ):
        asked = [*TRAIN, *SMALL, "seeds=0", "ablations=cgp", f"cluster={hosts[0].address}:{PORT}"]
        driver = hosts[0].start(
            grid,
            *(sys.executable, "-m", "conflow", "ablations", *asked),
            environment=environment | IMPATIENT | {"MLFLOW_TRACKING_URI": server.uri},
            output="output",
        )
        with stopped_afterwards(driver):
            wait(lambda: carries(server, "cgp-s0"), driver, grid / "output")
            (run,) = server.runs("cgp-s0")
            assert run.info.status == "RUNNING"
            (host,) = [host for host in hosts[1:] if host.name == run.data.tags["host"]]
            host.cut()
            old = Path(f"/proc/{run.data.tags['pid']}")
            wait(lambda: not old.exists(), driver, grid / "output")
            assert driver.wait(400) == 0, (grid / "output").read_text()
        (found,) = server.runs("cgp-s0")
        undisturbed.join(300)
        assert undisturbed.exitcode == 0, (alone / "output").read_text()
        (whole,) = processes.runs(alone)
        assert found.info.run_id == run.info.run_id
        assert (found.info.status, found.data.tags["resumed"]) == ("FINISHED", "1")
        (other,) = {"beta", "gamma"} - {host.name}
        assert found.data.tags["hosts"] == f"{host.name}; {other}"
        assert history(server, found) == processes.history(alone, whole)
        state = weights(server, found)
        assert all(torch.equal(tensor, state[name]) for name, tensor in processes.weights(whole).items())
