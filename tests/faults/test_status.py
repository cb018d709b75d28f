"""However a process ends, its run says what is true of it, at the latest to the next command."""

import os
import signal
import time
from pathlib import Path

import pytest

from conflow.tracking import liveness
from tests.faults import processes
from tests.faults.processes import killed_in, runs, store, wait_for_metrics

SHORT = ("train", "preset=smoke", "data.num=200", "train.max_steps=1", "sample.num=8", "sample.steps=1", "seed=99")
# Nothing but a signal ends this within the test.
ENDLESS = ("train", "preset=smoke", "data.num=200", "train.max_steps=1000000", "train.val_every=1000000")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("status")
    code, output = processes.run(folder, *SHORT)  # makes the store
    assert code == 0, output
    return folder


def test_a_process_that_dies_while_it_makes_the_store_leaves_none_that_is_half_made(tmp_path: Path) -> None:
    """Half of the tables would be refused by every later command, which makes them all instead."""
    death = killed_in("alembic.runtime.migration", "HeadMaintainer.update_to_step")
    assert processes.run(tmp_path, *SHORT, death=death)[0] == -signal.SIGKILL
    code, output = processes.run(tmp_path, *SHORT)
    assert code == 0, output
    assert [run.info.status for run in runs(tmp_path)] == ["FINISHED"]
    assert [path.name for path in (tmp_path / "runs").glob("*mlflow*")] == ["mlflow.db"]


def status(folder: Path, name: str) -> str:
    return next((str(run.info.status) for run in runs(folder) if run.info.run_name == name), "none")


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_run_is_killed_exits_with_the_signal_and_keeps_what_was_logged(
    signum: signal.Signals, folder: Path
) -> None:
    name = f"cgp-s{50 + signum}"
    process = processes.start(folder, *ENDLESS, f"seed={50 + signum}")
    wait_for_metrics(folder, name)
    os.kill(process.pid, signum)
    process.join(180)
    assert process.exitcode == 128 + signum
    assert (folder / "output").read_text().splitlines()[-1] == f"conflow: interrupted by {signum.name}"
    assert status(folder, name) == "KILLED"
    assert not list((folder / "runs" / "running").iterdir())


@pytest.mark.parametrize("command", ["compare", "reference", "ui", "figures", "evaluate"])
def test_ctrl_c_ends_every_command_in_one_line(command: str, tmp_path: Path) -> None:
    looks = "client" if command == "ui" else "exists"  # for the store
    code, output = processes.run(tmp_path, command, death=killed_in("conflow.tracking.store", looks, 1, signal.SIGINT))
    assert (code, output) == (128 + signal.SIGINT, "conflow: interrupted by SIGINT\n")


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("conflow.training.module", "Training.training_step"),
        ("conflow.tracking.recording", "_describe"),
        ("conflow.training.train", "evaluate"),
    ],
)
def test_a_run_whose_process_is_gone_is_marked_by_the_next_command(module: str, name: str, folder: Path) -> None:
    """SIGKILL, as of the system that runs out of memory; a power loss leaves the store alike."""
    code, output = processes.run(folder, *ENDLESS, "train.max_steps=20", death=killed_in(module, name))
    assert code == -signal.SIGKILL, output
    assert runs(folder)[0].info.status == "RUNNING"  # nobody was left to say otherwise
    code, output = processes.run(folder, "evaluate", "run=none")
    assert code == 2, output
    run = runs(folder)[0]
    assert run.info.status == "KILLED"
    assert run.data.tags["mlflow.note.content"] == liveness.GONE
    assert not list((folder / "runs" / "running").iterdir())


def test_a_failure_marks_the_run_failed_and_says_why_in_one_line(folder: Path) -> None:
    (folder / "runs" / "checkpoints").mkdir(parents=True, exist_ok=True)
    (folder / "runs" / "checkpoints").rename(folder / "runs" / "kept")
    (folder / "runs" / "checkpoints").write_text("in the way")
    try:
        code, output = processes.run(folder, *ENDLESS, "train.max_steps=20", "train.val_every=5", "seed=4")
    finally:
        (folder / "runs" / "checkpoints").unlink()
        (folder / "runs" / "kept").rename(folder / "runs" / "checkpoints")
    assert code == 2
    (said,) = [line for line in output.splitlines() if line.startswith("conflow:")]
    assert "expected to write a checkpoint, found File exists" in said or "Not a directory" in said
    assert status(folder, "cgp-s4") == "FAILED"


def test_a_run_that_is_alive_is_left_alone_and_cannot_be_gone_on_with(folder: Path) -> None:
    process = processes.start(folder, *ENDLESS, "seed=7")
    try:
        wait_for_metrics(folder, "cgp-s7")
        code, output = processes.run(folder, *ENDLESS, "seed=7", "resume=cgp-s7")
        assert code == 2
        assert "resume=cgp-s7: expected an interrupted run, found one that is RUNNING" in output
        assert status(folder, "cgp-s7") == "RUNNING"
    finally:
        process.kill()
        process.join()


def test_of_two_that_go_on_with_the_same_run_one_is_refused(folder: Path) -> None:
    code, _ = processes.run(
        folder, *ENDLESS, "seed=8", death=killed_in("conflow.training.module", "Training.training_step", call=3)
    )
    assert code == -signal.SIGKILL
    both = [processes.start(folder, *ENDLESS, "seed=8", "resume=cgp-s8") for _ in range(2)]
    deadline = time.monotonic() + 120
    while all(process.is_alive() for process in both) and time.monotonic() < deadline:
        time.sleep(0.3)
    codes = {process.exitcode for process in both}
    for process in both:
        process.kill()
        process.join()
    assert codes == {2, None}  # one was refused while the other went on


def test_a_run_of_another_machine_is_nobodys_here_to_judge(folder: Path) -> None:
    code, _ = processes.run(
        folder, *ENDLESS, "seed=9", death=killed_in("conflow.training.module", "Training.training_step")
    )
    assert code == -signal.SIGKILL
    store(folder).set_tag(runs(folder)[0].info.run_id, "host", "elsewhere")
    processes.run(folder, "evaluate", "run=none")
    assert status(folder, "cgp-s9") == "RUNNING"
    store(folder).set_terminated(runs(folder)[0].info.run_id, "KILLED")


def test_a_dead_run_is_recognised_after_its_folder_has_moved(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.mkdir()
    code, output = processes.run(
        old, *ENDLESS, "seed=1", death=killed_in("conflow.training.module", "Training.training_step")
    )
    assert code == -signal.SIGKILL, output
    new = old.rename(tmp_path / "new")
    processes.run(new, "evaluate", "run=none")
    assert status(new, "cgp-s1") == "KILLED"
