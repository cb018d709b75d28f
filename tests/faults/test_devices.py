"""Several processes that train one run: what they make is one process's, and what happens to one of them."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from mlflow.entities import Run

from conflow.scene.tasks.swap import swap
from tests.faults import processes
from tests.faults.processes import Death, history, killed_in, runs, store, wait_for_metrics, weights

TRAIN = (
    *("train", "preset=smoke", "data.num=200", "train.max_steps=41", "train.val_every=10", "train.log_every=7"),
    *("train.batch_size=24", "sample.num=8", "sample.steps=3"),
)
STEP = ("conflow.training.module", "Training.training_step")
LOST = "conflow: lost another of the 2 processes that train together; try: ... resume=latest\n"


class Outcome(NamedTuple):
    """Exit code of a process, negative for a signal that killed it, and what it printed."""

    code: int
    output: str

    @property
    def said(self) -> list[str]:
        """Its lines, without a warning of torch, which was imported here before it was told to keep it."""
        return [line for line in self.output.splitlines() if not line.startswith("[rank")]


class Rank:
    """Makes a process one of several, as torchrun does; what befalls it comes after."""

    def __init__(self, rank: int, world: int, port: int, death: Death | None) -> None:
        self.death = death
        self.environment = {"TORCHELASTIC_RUN_ID": "test", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        self.environment |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
        self.environment |= {"WORLD_SIZE": str(world), "LOCAL_WORLD_SIZE": str(world)}

    def __call__(self) -> None:
        os.environ.update(self.environment)
        if self.death is not None:
            self.death()


def start(folder: Path, *arguments: str, world: int = 2, deaths: Mapping[int, Death] | None = None) -> list[Any]:
    """A command in several processes. All but the first one work in folders of their own, without anything in them."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    started = []
    for rank in range(world):
        place(folder, rank).mkdir(exist_ok=True)
        death = Rank(rank, world, port, (deaths or {}).get(rank))
        started.append(processes.start(place(folder, rank), *arguments, death=death))
    return started


def ended(folder: Path, started: list[Any]) -> list[Outcome]:
    """What became of processes."""
    try:
        for process in started:
            process.join(120)
        assert all(process.exitcode is not None for process in started), "a process waits for another for ever"
    finally:
        for process in started:
            process.kill()
    return [
        Outcome(process.exitcode, (place(folder, rank) / "output").read_text()) for rank, process in enumerate(started)
    ]


def place(folder: Path, rank: int) -> Path:
    return folder / f"rank-{rank}" if rank else folder


def run(folder: Path, *arguments: str, world: int = 2, deaths: Mapping[int, Death] | None = None) -> list[Outcome]:
    return ended(folder, start(folder, *arguments, world=world, deaths=deaths))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("devices")


@pytest.fixture(scope="module")
def whole(folder: Path) -> Run:
    """The run of two processes that nothing interrupts."""
    first, second = run(folder, *TRAIN)
    assert first.code == second.code == 0, first.output + second.output
    assert not (folder / "rank-1" / "runs").exists(), "the first one alone touches the store"
    return runs(folder)[0]


ROUNDING = 1e-4
"""Relative, of single precision over 41 steps of Adam, which makes a sign of a gradient that is but rounding."""


def assert_equal_up_to_rounding(folder: Path, one: Run, other: Run) -> None:
    assert one.data.tags["config_sha"] == other.data.tags["config_sha"]
    expected = weights(one)
    for name, tensor in weights(other).items():
        torch.testing.assert_close(tensor, expected[name], rtol=ROUNDING, atol=ROUNDING / 10)
    histories = [history(folder, run) for run in (one, other)]
    for key in ("train/loss", "val/loss", "train/grad_norm"):
        steps, values = zip(*histories[0][key], strict=True)
        steps_of_other, values_of_other = zip(*histories[1][key], strict=True)
        assert steps == steps_of_other
        np.testing.assert_allclose(values, values_of_other, rtol=ROUNDING)
    assert one.data.metrics.keys() == other.data.metrics.keys()
    assert one.data.metrics["test/none/num"] == other.data.metrics["test/none/num"]


def test_two_processes_train_what_one_does(folder: Path, whole: Run) -> None:
    code, output = processes.run(folder, *TRAIN)
    assert code == 0, output
    assert (whole.data.tags["devices"], runs(folder)[0].data.tags["devices"]) == ("2", "1")
    assert_equal_up_to_rounding(folder, runs(folder)[0], whole)


@pytest.mark.parametrize(
    "method", [("ablation=plus",), ("task=weave", "ablation=plus", "task.robots=[2,3]", "train.batch_size=12")]
)
def test_so_they_do_with_other_losses_and_batches_of_several_sizes(method: tuple[str, ...], folder: Path) -> None:
    asked = (*TRAIN, "train.max_steps=12", *method)
    first, second = run(folder, *asked)
    assert first.code == second.code == 0, first.output + second.output
    code, output = processes.run(folder, *asked)
    assert code == 0, output
    assert_equal_up_to_rounding(folder, *runs(folder)[:2])


@pytest.mark.parametrize(("rank", "step"), [(0, 26), (1, 26)])
def test_where_one_is_killed_all_end_and_the_run_goes_on_with_the_same_bits(
    rank: int, step: int, folder: Path, whole: Run
) -> None:
    outcomes = run(folder, *TRAIN, deaths={rank: killed_in(*STEP, call=step)})
    assert outcomes[rank].code == -signal.SIGKILL, outcomes
    assert outcomes[1 - rank].code == 2, outcomes
    if rank:
        assert outcomes[0].output.endswith(LOST), outcomes[0].output
    else:
        assert outcomes[1].said == []
    assert_ends_as(whole, folder)


def assert_ends_as(whole: Run, folder: Path, world: int = 2) -> None:
    """The newest interrupted run, gone on with."""
    interrupted = runs(folder)[0]
    outcomes = run(folder, *TRAIN, "resume=latest", world=world)
    assert [outcome.code for outcome in outcomes] == [0] * world, outcomes
    resumed = store(folder).get_run(interrupted.info.run_id)
    assert (resumed.info.status, resumed.data.tags["resumed"]) == ("FINISHED", "1")
    expected = weights(whole)
    assert all(torch.equal(tensor, expected[name]) for name, tensor in weights(resumed).items())
    assert history(folder, resumed) == history(folder, whole)


def test_three_add_up_in_the_same_order_after_they_were_stopped(folder: Path, whole: Run) -> None:
    """Of two gradients there is one sum; of three there would be another where they had moved to other places."""
    assert [outcome.code for outcome in run(folder, *TRAIN, world=3)] == [0, 0, 0]
    three = runs(folder)[0]
    run(folder, *TRAIN, world=3, deaths={2: killed_in(*STEP, call=26)})
    assert_ends_as(three, folder, world=3)


def test_a_run_goes_on_with_another_number_of_processes_and_says_so(folder: Path, whole: Run) -> None:
    run(folder, *TRAIN, deaths={1: killed_in(*STEP, call=26)})
    interrupted = runs(folder)[0]
    code, output = processes.run(folder, *TRAIN, "resume=latest")
    assert code == 0, output
    assert "Begun on 2 devices, going on on 1: equal to a training on either up to rounding" in output
    assert_equal_up_to_rounding(folder, store(folder).get_run(interrupted.info.run_id), whole)


class Replaced:
    """Replaces module.name within a process."""

    def __init__(self, module: str, name: str, value: Any) -> None:
        self.module, self.name, self.value = module, name, value

    def __call__(self) -> None:
        import importlib

        setattr(importlib.import_module(self.module), self.name, self.value)


def test_the_first_ones_clock_says_when_to_save(folder: Path, whole: Run) -> None:
    """Saving is for all at once: were the second one's minute over first, it would wait there for ever."""
    outcomes = run(folder, *TRAIN, deaths={1: Replaced("conflow.tracking.checkpoints", "SECONDS", -1.0)})
    assert [outcome.code for outcome in outcomes] == [0, 0], outcomes
    assert history(folder, runs(folder)[0]) == history(folder, whole)


class NotANumber:
    """From a step on the loss is none."""

    def __call__(self) -> None:
        from conflow.training.module import Training

        loss, left = Training.loss, iter([1.0] * 8)

        def broken(self: Training, *given: Any) -> torch.Tensor:
            return loss(self, *given) * next(left, float("nan"))

        Training.loss = broken  # type: ignore[method-assign, assignment]


def test_a_loss_that_is_no_number_in_one_ends_all_at_the_same_step(folder: Path, whole: Run) -> None:
    """The norm of the gradient is that of all, so each stops before the weights change, and the first one says it."""
    first, second = run(folder, *TRAIN, deaths={1: NotANumber()})
    assert (first.code, second.code, second.said) == (2, 2, [])
    (said,) = [line for line in first.said if line.startswith("conflow:")]
    assert "the norm of the gradient is nan, expected a finite number: step" in said
    assert runs(folder)[0].info.status == "FAILED"


def test_a_signal_to_all_ends_all_and_the_run_is_killed(folder: Path, whole: Run) -> None:
    """As torchrun passes it on, whoever meets it first: none waits for another that waits for it."""
    started = start(folder, *TRAIN, "train.max_steps=1000000", "train.val_every=1000000", "seed=70")
    wait_for_metrics(folder, "cgp-s70")
    for process in reversed(started):
        os.kill(process.pid, signal.SIGTERM)
    first, second = ended(folder, started)
    assert (first.code, second.code) == (128 + signal.SIGTERM,) * 2
    assert first.output.splitlines()[-1] == "conflow: interrupted by SIGTERM"
    assert second.said == []
    assert runs(folder)[0].info.status == "KILLED"


def test_what_cannot_be_shared_or_differs_is_refused_in_one_line_by_the_first_one(folder: Path, whole: Run) -> None:
    for rank in (0, 1):
        np.savez(place(folder, rank) / "other.npz", x=swap(100, seed=rank).numpy())
    np.savez(folder / "mine.npz", x=swap(100).numpy())
    before = len(runs(folder))
    refused = {
        "train.batch_size=25": "train.batch_size=25: found batches of 25, expected batches that divide by 2, the",
        "data.path=mine.npz": "data.path=mine.npz: no such file",
        "data.path=other.npz": "data_digest: found ",
        "train.lr=-1": "train.lr=-1.0: expected a finite number above 0",
        "resume=cgp-s9": "resume=cgp-s9: ",
    }
    for argument, said in refused.items():
        first, second = run(folder, *TRAIN, "ablation=fm_mixed", argument)
        assert (first.code, second.code) == (2, 2), (argument, first.output, second.output)
        assert said in first.output
        assert len(first.said) == 1, first.output
        assert second.said == [], argument
    assert "rank 1 on " in run(folder, *TRAIN, "ablation=fm_mixed", "data.path=mine.npz")[0].output
    assert len(runs(folder)) == before


class InSlurm:
    """What a process finds that SLURM started as one of several tasks."""

    def __call__(self) -> None:
        os.environ |= {"SLURM_JOB_ID": "1", "SLURM_JOB_NAME": "job", "SLURM_NTASKS": "4", "SLURM_PROCID": "3"}
        os.environ |= {"SLURM_LOCALID": "3", "SLURM_NODEID": "0", "SLURM_NTASKS_PER_NODE": "4"}


def test_a_task_of_slurm_trains_alone_and_takes_up_nothing_that_lies_about(folder: Path, whole: Run) -> None:
    """Lightning would take it for rank 3 of 4, and load `hpc_ckpt_1.ckpt` of the current folder."""
    (folder / "hpc_ckpt_1.ckpt").write_bytes(b"another run's")
    code, output = processes.run(folder, *TRAIN, death=InSlurm())
    assert code == 0, output
    assert_equal_up_to_rounding(folder, runs(folder)[0], whole)


def test_torchrun_ends_all_with_one_and_passes_signals_on(folder: Path, whole: Run) -> None:
    """The command of `make train DEVICES=2` itself: its second process is killed; it goes on, and is told to end."""
    endless = ("train.max_steps=1000000", "train.val_every=1000000", "seed=80")
    launched = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "-m", "conflow"]
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"}
    for number, resume in enumerate(((), ("resume=latest",))):
        with (folder / "torchrun").open("w") as output:
            agent = subprocess.Popen(
                [*launched, *TRAIN, *endless, *resume],
                cwd=folder,
                env=environment,
                stdout=output,
                stderr=subprocess.STDOUT,
            )
            try:
                wait_for_work(folder, "cgp-s80", resumed=number)
                workers = children(agent.pid)
                if resume:
                    agent.terminate()
                else:
                    os.kill(workers["1"], signal.SIGKILL)
                assert agent.wait(90) != 0
            finally:
                agent.kill()
        said = (folder / "torchrun").read_text()
        (run,) = [run for run in runs(folder) if run.info.run_name == "cgp-s80"]
        assert run.info.status in (("KILLED",) if resume else ("KILLED", "FAILED"))
        assert len([line for line in said.splitlines() if line.startswith("conflow:")]) == 1, said
        assert not any(Path("/proc", str(pid)).exists() for pid in workers.values())


def wait_for_work(folder: Path, name: str, resumed: int) -> None:
    """Until the run of this name is at work for the second time, or the first."""
    deadline = time.monotonic() + 180
    while time.monotonic() < deadline:
        for run in runs(folder):
            begun = int(run.data.tags.get("resumed", 0)) == resumed and run.info.status == "RUNNING"
            if run.info.run_name == name and begun and "train/loss" in run.data.metrics:
                time.sleep(2 * resumed)
                return
        time.sleep(0.5)
    raise TimeoutError((folder / "torchrun").read_text())


def children(pid: int) -> dict[str, int]:
    """The processes that torchrun started, by rank."""
    found: dict[str, int] = {}
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        environment = Path("/proc", child, "environ").read_bytes().decode().split("\0")
        ranks = [entry.partition("=")[2] for entry in environment if entry.startswith("RANK=")]
        found |= {rank: int(child) for rank in ranks}
    assert found.keys() == {"0", "1"}, json.dumps(found)
    return found
