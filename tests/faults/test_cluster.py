"""A grid on a Ray cluster of three nodes that loses a node, its terminal, and its driver."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from mlflow import MlflowClient
from mlflow.entities import Run

import conflow
from conflow.errors import ConfigError
from tests.faults import processes, test_postgresql
from tests.faults.test_concurrency import stopped_afterwards
from tests.faults.test_postgresql import Server

pytest.importorskip("ray", reason="no Ray to test with, missing: the extra cluster")
pytestmark = test_postgresql.pytestmark
database, server = test_postgresql.database, test_postgresql.server

LONG = ("preset=smoke", "data.num=200", "train.max_steps=3000", "train.val_every=500", "train.batch_size=16")
SMALL = ("sample.num=8", "sample.steps=3")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A head that trains nothing, and two nodes for a cell each."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", str(Path(conflow.__file__).parents[1]))
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
        for _ in range(2):
            made.add_node(num_cpus=1)
        yield made
        made.shutdown()


def grid(folder: Path, cluster: Any, server: Server, *arguments: str) -> "subprocess.Popen[str]":
    """The command at work in a folder, its output in the file `output` there."""
    command = [sys.executable, "-m", "conflow", "ablations", *LONG, *SMALL, f"cluster={cluster.address}", *arguments]
    environment = {
        **os.environ,
        "MLFLOW_TRACKING_URI": server.uri,
        "PYTHONPATH": str(Path(conflow.__file__).parents[1]),
    }
    with (folder / "output").open("w") as output:
        return subprocess.Popen(
            command, cwd=folder, env=environment, text=True, stdout=output, stderr=subprocess.STDOUT
        )


def at_work(server: Server, name: str, driver: "subprocess.Popen[str]", folder: Path) -> Run:
    """A run as soon as it trains."""
    deadline = time.monotonic() + 240
    while time.monotonic() < deadline:
        for run in server.runs(name):
            if run.info.status == "RUNNING" and "val/loss" in run.data.metrics:
                return run
        assert driver.poll() is None, (folder / "output").read_text()
        time.sleep(0.3)
    raise TimeoutError((folder / "output").read_text())


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def history(client: MlflowClient, run: Run) -> dict[str, list[tuple[int, float]]]:
    """Every metric's steps and values, a point that was written twice twice, but for those that are times."""
    return {
        key: sorted((point.step, point.value) for point in client.get_metric_history(run.info.run_id, key))
        for key in run.data.metrics
        if not key.endswith(("steps_per_second", "train/seconds", "latency_ms"))
    }


def test_a_cell_whose_node_is_removed_ends_as_if_nothing_had_happened(
    cluster: Any, server: Server, tmp_path: Path
) -> None:
    """The undisturbed run is of a store of its own, where the grid does not find it."""
    alone = tmp_path / "alone"
    alone.mkdir()
    undisturbed = processes.start(alone, "train", *LONG, *SMALL)
    driver = grid(tmp_path, cluster, server, "seeds=0", "ablations=cgp")
    with stopped_afterwards(driver):
        run = at_work(server, "cgp-s0", driver, tmp_path)
        raylet = parent(parent(int(run.data.tags["pid"])))
        (node,) = [one for one in cluster.worker_nodes if one.all_processes["raylet"][0].process.pid == raylet]
        cluster.remove_node(node, allow_graceful=False)
        assert driver.wait(300) == 0, (tmp_path / "output").read_text()
    undisturbed.join(200)
    assert undisturbed.exitcode == 0, (alone / "output").read_text()
    (found,), (whole,) = server.runs("cgp-s0"), processes.runs(alone)
    assert found.info.run_id == run.info.run_id
    assert (found.info.status, found.data.tags["resumed"]) == ("FINISHED", "1")
    client = MlflowClient(server.uri)
    assert history(client, found) == history(processes.store(alone), whole)
    state = torch.load(server.kept(found) / "model.ckpt", weights_only=True)["state_dict"]
    assert all(torch.equal(tensor, state[name]) for name, tensor in processes.weights(whole).items())
    said = (tmp_path / "runs" / "output" / "smoke" / "cgp-s0.txt").read_text()
    assert said.count("\nGoing on with run cgp-s0 from step ") == 1
    cluster.add_node(num_cpus=1)


def test_a_grid_that_is_interrupted_and_whose_driver_is_killed_goes_on_by_the_same_command(
    cluster: Any, server: Server, tmp_path: Path
) -> None:
    asked = ("seeds=1", "ablations=cgp")
    driver = grid(tmp_path, cluster, server, *asked)
    with stopped_afterwards(driver):
        run = at_work(server, "cgp-s1", driver, tmp_path)
        driver.send_signal(signal.SIGINT)
        assert driver.wait(120) == 128 + signal.SIGINT, (tmp_path / "output").read_text()
    assert (tmp_path / "output").read_text().splitlines()[-1] == "conflow: interrupted by SIGINT"
    # It has waited for the cell, which has said so itself.
    assert [one.info.status for one in server.runs("cgp-s1")] == ["KILLED"]
    assert not Path(f"/proc/{run.data.tags['pid']}").exists()

    driver = grid(tmp_path, cluster, server, *asked)
    with stopped_afterwards(driver):
        run = at_work(server, "cgp-s1", driver, tmp_path)
        driver.kill()
        driver.wait()
    deadline = time.monotonic() + 60
    while Path(f"/proc/{run.data.tags['pid']}").exists():
        assert time.monotonic() < deadline, "a cell outlives its grid"
        time.sleep(0.3)

    driver = grid(tmp_path, cluster, server, *asked)
    with stopped_afterwards(driver):
        assert driver.wait(300) == 0, (tmp_path / "output").read_text()
    (found,) = server.runs("cgp-s1")
    assert (found.info.run_id, found.info.status) == (run.info.run_id, "FINISHED")
    assert found.data.tags["resumed"] == "2"
    driver = grid(tmp_path, cluster, server, *asked)
    with stopped_afterwards(driver):
        assert driver.wait(300) == 0, (tmp_path / "output").read_text()
    assert len(server.runs("cgp-s1")) == 1, "it was finished before"


def test_a_node_with_other_code_or_libraries_is_refused_by_name() -> None:
    from conflow.grid import cluster
    from conflow.tracking import code, recording

    files, versions = dict(code.files()), recording.versions()
    same = cluster.Node("alpha", files, versions, "", "")
    cluster._check_alike("auto", [same])
    changed = cluster.Node("beta", files | {"flow/path.py": "00000000"}, versions, "", "")
    with pytest.raises(ConfigError, match=r"^cluster=auto: node beta: found other flow/path\.py, expected the same as"):
        cluster._check_alike("auto", [same, changed])
    older = cluster.Node("gamma", files, versions | {"torch": "2.12.0"}, "", "")
    with pytest.raises(ConfigError, match=r"node gamma: found other torch 2\.12\.0, expected .*: torch 2\.13\.0"):
        cluster._check_alike("auto", [same, older])


def test_several_hosts_need_a_server_that_all_of_them_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    from conflow.grid import cluster

    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    alpha, beta = (cluster.Node(name, {}, {}, "", "") for name in ("alpha", "beta"))
    cluster._check_store("auto", [alpha], shared=True)
    for nodes, shared in (([alpha, beta], True), ([alpha], False)):
        with pytest.raises(ConfigError, match=r"MLFLOW_TRACKING_URI=: found nodes on alpha.*, expected the addr"):
            cluster._check_store("auto", nodes, shared)
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")
    cluster._check_store("auto", [alpha, beta], shared=False)
    deaf = cluster.Node("gamma", {}, {}, "", "MLFLOW_TRACKING_URI=http://127.0.0.1:9: Connection refused")
    with pytest.raises(ConfigError, match=r"cluster=auto: node gamma: MLFLOW_TRACKING_URI=\S+ Connection refused"):
        cluster._check_store("auto", [alpha, deaf], shared=True)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["cluster=127.0.0.1:9"], "cluster=127.0.0.1:9: 127.0.0.1:9: Connection refused; expected a Ray cluster"),
        (["cluster=nowhere"], "cluster=nowhere: expected auto or host:port"),
        (["cpus=8"], "cpus=8 gpus=0: expected what a node has, at most 1 and 0"),
    ],
)
def test_a_cluster_that_cannot_be_used_is_refused_in_one_line(
    arguments: list[str], said: str, cluster: Any, server: Server, tmp_path: Path
) -> None:
    driver = grid(tmp_path, cluster, server, "seeds=0", "ablations=cgp", *arguments)
    with stopped_afterwards(driver):
        assert driver.wait(120) == 2
    (line,) = (tmp_path / "output").read_text().splitlines()
    assert line.startswith(f"conflow: {said}")


def test_a_driver_without_the_clusters_token_is_refused_in_one_line(
    cluster: Any, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "none"))
    driver = grid(tmp_path, cluster, server, "seeds=0", "ablations=cgp")
    with stopped_afterwards(driver):
        assert driver.wait(120) == 2
    (line,) = (tmp_path / "output").read_text().splitlines()
    assert line.startswith("conflow: cluster=")
    assert line.endswith("; expected that of the cluster, see ray get-auth-token")
