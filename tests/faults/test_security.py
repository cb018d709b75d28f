"""What a hostile file, name or setting may do: nothing. Each is really tried."""

import os
import pickle
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from conflow.errors import ConfigError
from conflow.tracking import store
from conflow.training import config
from conflow.training.config import CONF
from conflow.training.model_file import MODEL_FILE
from tests.faults.conftest import RUN, Run, assert_refused, listing

PAIR = ("start=-0.8,0,0.8,0", "goal=0.8,0,-0.8,0")


class Bomb:
    """An object whose unpickling leaves a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.path,))


def pickled(path: Path, bomb: Bomb) -> None:
    path.write_bytes(pickle.dumps(bomb))


def in_an_array(path: Path, bomb: Bomb) -> None:
    np.savez(path, x=np.array([bomb], dtype=object), violates=np.array([bomb], dtype=object))


def in_an_archive(path: Path, bomb: Bomb) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("x.npy", pickle.dumps(bomb))


def in_a_checkpoint(path: Path, bomb: Bomb) -> None:
    torch.save({"conflow": {"config": bomb, "T": 32, "D": 4}, "state_dict": bomb}, path)


def test_the_bombs_go_off_where_pickle_is_trusted(tmp_path: Path) -> None:
    """Or the tests below would prove nothing."""
    sprung = tmp_path / "sprung"
    in_an_array(tmp_path / "x.npz", Bomb(sprung))
    with np.load(tmp_path / "x.npz", allow_pickle=True) as file:
        assert file["x"].shape == (1,)
    assert sprung.exists()
    sprung.unlink()
    in_a_checkpoint(tmp_path / "x.ckpt", Bomb(sprung))
    torch.load(tmp_path / "x.ckpt", weights_only=False)
    assert sprung.exists()


@pytest.mark.parametrize("plant", [pickled, in_an_array, in_an_archive])
def test_demonstrations_run_no_code(
    plant: Callable[[Path, Bomb], None], command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    plant(tmp_path / "bomb.npz", Bomb(tmp_path / "sprung"))
    assert_refused(command("train", "preset=smoke", "data.path=bomb.npz"), "data.path=bomb.npz: ", "expected")
    assert list(listing(tmp_path)) == ["bomb.npz"]


@pytest.mark.parametrize("plant", [pickled, in_a_checkpoint])
@pytest.mark.parametrize("arguments", [("sample", *PAIR), ("evaluate",), ("figures",)])
def test_a_runs_model_runs_no_code(
    arguments: tuple[str, ...],
    plant: Callable[[Path, Bomb], None],
    command: Run,
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained / "runs", "runs")
    (model,) = Path("runs").rglob(MODEL_FILE)
    plant(model, Bomb(tmp_path / "sprung"))
    before = listing(tmp_path)
    assert_refused(command(*arguments, f"run={RUN}"), MODEL_FILE, "expected")
    assert listing(tmp_path) == before


def test_a_models_settings_do_not_read_the_environment(
    command: Run, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SECRET", "swordfish")
    checkpoint = torch.load(trained / MODEL_FILE, weights_only=True)
    checkpoint["conflow"]["config"]["ablation"] = "${oc.env:SECRET}"
    torch.save(checkpoint, MODEL_FILE)
    with pytest.raises(ConfigError, match=r"^ablation=\$\{oc.env:SECRET\}: expected"):
        config.from_tree(checkpoint["conflow"]["config"])
    outcome = command("sample", f"run=./{MODEL_FILE}", *PAIR)
    assert_refused(outcome, f"run=./{MODEL_FILE}: ablation=${{oc.env:SECRET}}: expected a name")
    assert "swordfish" not in outcome.err + outcome.out


def test_a_settings_yaml_runs_no_code(command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    bomb = f"!!python/object/apply:os.mkdir [{tmp_path / 'sprung'}]"
    for key in ("seed", "data.amplitudes", "train.lr", "data.negatives"):
        assert_refused(command("train", f"{key}={bomb}"), f"{key}=!!python/object", "expected")
    assert not listing(tmp_path)


@pytest.mark.parametrize("axis", ["ablation", "preset"])
def test_an_ablation_or_preset_is_a_file_of_conf_alone(
    axis: str, command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is there, and the path to it is right."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.yaml").write_text("seed: 7\n")
    name = os.path.relpath(tmp_path / "x", CONF / axis)
    assert (CONF / axis / f"{name}.yaml").is_file()
    for wanted in (name, str(tmp_path / "x"), "../../x", f"../{axis}/smoke"):
        assert_refused(command("train", f"{axis}={wanted}"), f"{axis}=", "expected one of")
    assert list(listing(tmp_path)) == ["x.yaml"]


def test_a_run_cannot_be_named_out_of_the_folder_of_pictures(
    command: Run, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Renamed in MLflow's pages, and drawn: all that is new lies in the run's own folders."""
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    shutil.copytree(trained / "runs", "runs")
    client = store.client()
    run = store.find_run(RUN)
    client.update_run(run.info.run_id, name="../../x")
    before = set(listing(tmp_path))
    outcome = command("figures", "run=../../x")
    assert (outcome.code, outcome.err) == (0, "")
    new = {Path(path) for path in set(listing(tmp_path)) - before}
    own = (Path("a/b/runs/figures"), Path("a/b/runs/artifacts", run.info.run_id))
    assert Path("a/b/runs/figures/smoke_.._.._x/page.png") in new
    assert {path for path in new if not any(path.is_relative_to(folder) for folder in own)} <= {
        Path("a/b/runs/running")
    }


def test_settings_cannot_lead_an_evaluation_out_of_the_runs_artifacts(
    command: Run, tmp_path: Path, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their text becomes a file's name, and YAML would take the rest of it for a comment."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained / "runs", "runs")
    before = listing(tmp_path)
    for argument in ("seed=3 # /../../../../x", "sample.steps=5 #/../../x", "sample.obstacle.x=0.1 # ../../x"):
        assert_refused(command("evaluate", argument), argument.partition("=")[0], "expected")
    assert listing(tmp_path) == before


def test_the_pages_are_served_to_this_machine_alone(trained: Path) -> None:
    """The server's socket listens on 127.0.0.1 and on nothing else."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    server = subprocess.Popen(
        [sys.executable, "-m", "conflow", "ui", f"port={port}"],
        cwd=trained,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        deadline = time.monotonic() + 120
        while not listening(port) and time.monotonic() < deadline:
            time.sleep(0.3)
        assert listening(port) == {"127.0.0.1"}
        with socket.socket() as other:
            # Any of this machine's other addresses is refused.
            assert other.connect_ex(("127.0.0.2", port)) != 0
    finally:
        os.killpg(server.pid, signal.SIGKILL)
        server.wait(timeout=30)


def listening(port: int) -> set[str]:
    """The addresses on which this machine listens at a port."""
    found = set()
    for table, family in (("tcp", socket.AF_INET), ("tcp6", socket.AF_INET6)):
        for line in Path("/proc/net", table).read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            address, at = local.split(":")
            if state == "0A" and int(at, 16) == port:
                words = [bytes.fromhex(address[i : i + 8])[::-1] for i in range(0, len(address), 8)]
                found.add(socket.inet_ntop(family, b"".join(words)))
    return found


def test_versions_are_locked_exactly() -> None:
    lines = (CONF.parent / "requirements.lock").read_text().splitlines()
    assert len(lines) > 50
    loose = [line for line in lines if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][A-Za-z0-9.!+]*", line)]
    assert not loose
    project = tomllib.loads((CONF.parent / "pyproject.toml").read_text())
    assert all("==" in requirement for requirement in project["build-system"]["requires"])
    locked = {re.sub(r"[-_.]+", "-", line.partition("==")[0]).lower() for line in lines}
    wanted = project["project"]["dependencies"]
    assert {re.split(r"[<>=\s]", line)[0].lower() for line in wanted} <= locked
