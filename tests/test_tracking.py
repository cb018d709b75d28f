import io
import os
import shutil
import signal
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mlflow import MlflowClient
from mlflow.artifacts import list_artifacts
from mlflow.entities import Run
from rich.console import Console
from sqlalchemy import Engine, event

from conflow import errors
from conflow.grid.local import Job, finished
from conflow.results.records import Record
from conflow.scene.tasks.swap import swap
from conflow.tracking import code, liveness, recording, resume, signals, store
from conflow.training import config
from conflow.training.datamodule import DemonstrationData
from conflow.training.progress import ProgressDisplay
from conflow.training.train import experiment
from tests.conftest import raising_signals


@pytest.fixture
def store_folder(tmp_path: Path, workplace: Path, conflow: object, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of its own with an empty client."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    folder = tmp_path / "before"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def test_artifacts_are_found_again_after_the_folder_has_moved(
    store_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = config.load(["preset=smoke"])
    with recording.start(experiment(settings, DemonstrationData(settings))) as logger:
        run_id = str(logger.run_id)
    after = store_folder.parent / "after it has moved"
    shutil.move(store_folder, after)
    monkeypatch.chdir(after)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)  # which MLflow sets within a process
    uri = store.client().get_run(run_id).info.artifact_uri
    assert uri is not None
    # By its address: within one process MLflow remembers where a run's artifacts were.
    assert [Path(artifact.path).name for artifact in list_artifacts(artifact_uri=uri)] == ["config.yaml"]
    assert uri.startswith((after / "runs" / "artifacts").as_uri())


def test_metrics_are_written_in_batches_and_none_is_lost(store_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_SECONDS", 3600)  # however slow the machine is
    settings = config.load(["preset=smoke"])
    with recording.start(experiment(settings, DemonstrationData(settings))) as logger:
        written: list[int] = []
        log_batch = logger.store.log_batch

        def counted(run_id: str, **entities: list[object]) -> None:
            written.append(len(entities["metrics"]))
            log_batch(run_id, **entities)  # type: ignore[arg-type]

        logger.store.log_batch = counted  # type: ignore[method-assign, assignment]
        for step in range(2500):
            logger.log_metrics({"train/loss": 1 / (step + 1)}, step)
    assert sum(written) == 2500
    assert written == [1000, 1000, 500]
    history = logger.store.get_metric_history(str(logger.run_id), "train/loss")
    assert [metric.step for metric in history] == list(range(2500))


def test_a_run_that_raises_is_failed_and_keeps_its_metrics(store_folder: Path) -> None:
    settings = config.load(["preset=smoke"])

    def fail() -> None:
        with recording.start(experiment(settings, DemonstrationData(settings))) as logger:
            ids.append(str(logger.run_id))
            logger.log_metrics({"train/loss": 0.5}, 1)
            raise RuntimeError("deliberately")

    ids: list[str] = []
    with pytest.raises(RuntimeError, match="deliberately"):
        fail()
    run = store.client().get_run(ids[0])
    assert run.info.status == "FAILED"
    assert run.data.metrics["train/loss"] == 0.5


def test_a_signal_while_the_store_makes_the_run_leaves_no_run_that_says_running(
    store_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The signal comes after the store's commit and before its answer."""
    created: list[str] = []
    create_run = MlflowClient.create_run

    def interrupted(client: MlflowClient, *arguments: Any, **options: Any) -> Run:
        run = create_run(client, *arguments, **options)
        created.append(run.info.run_id)
        os.kill(os.getpid(), signal.SIGTERM)
        return run

    monkeypatch.setattr(MlflowClient, "create_run", interrupted)
    settings = config.load(["preset=smoke"])
    data = DemonstrationData(settings)
    with (
        raising_signals(),
        pytest.raises(signals.Interrupted, match="SIGTERM"),
        recording.start(experiment(settings, data)),
    ):
        pytest.fail("the run began")
    assert store.client().get_run(created[0]).info.status == "KILLED"


@pytest.mark.parametrize("table", ["params", "datasets", "metrics"])
def test_a_signal_breaks_off_no_transaction_of_the_store(table: str, store_folder: Path) -> None:
    """Raised in there, it would leave the transaction open, and the store locked for the run's own end."""
    settings = config.load(["preset=smoke"])
    data = DemonstrationData(settings)
    sent: list[str] = []

    def interrupt(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        if statement.startswith(f"INSERT INTO {table}"):
            if not sent:
                os.kill(os.getpid(), signal.SIGTERM)
            sent.append(statement)

    def write() -> None:
        with recording.start(experiment(settings, data)) as logger:
            logger.log_metrics({"train/loss": 0.5}, 1)
            logger.save()
            pytest.fail("nothing interrupted it")

    store.client()  # the client has its tables before
    event.listen(Engine, "after_cursor_execute", interrupt)
    try:
        with raising_signals(), pytest.raises(signals.Interrupted, match="SIGTERM"):
            write()
    finally:
        event.remove(Engine, "after_cursor_execute", interrupt)
    assert len(sent) == 1  # written, and not a second time as the run ended
    (run,) = store.runs()
    assert run.info.status == "KILLED"
    assert run.data.params["seed"] == "0"
    assert run.inputs is not None
    assert len(run.inputs.dataset_inputs) == 1
    assert run.data.metrics == ({"train/loss": 0.5} if table == "metrics" else {})


def test_a_signal_does_not_break_off_the_making_of_the_store(store_folder: Path) -> None:
    """Half of the tables would be left, and every later command refused."""
    sent: list[str] = []

    def interrupt(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        if statement.lstrip().startswith("ALTER TABLE") and not sent:
            sent.append(statement)
            os.kill(os.getpid(), signal.SIGINT)

    event.listen(Engine, "after_cursor_execute", interrupt)
    try:
        with raising_signals(), pytest.raises(signals.Interrupted, match="SIGINT"):
            store.client()
    finally:
        event.remove(Engine, "after_cursor_execute", interrupt)
    assert sent
    assert store.runs() == []


def test_a_server_that_does_not_answer_keeps_no_signal_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://127.0.0.1:9")

    def write() -> None:
        with store.whole():
            os.kill(os.getpid(), signal.SIGINT)
            pytest.fail("it waited")

    with raising_signals(), pytest.raises(signals.Interrupted):
        write()


def test_a_signal_that_is_sent_on_again_is_one_request() -> None:
    """As of `timeout`, which tells make and its processes; a second Ctrl-C, later, is another."""
    with raising_signals():
        with pytest.raises(signals.Interrupted, match="SIGTERM"):
            os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(signals.REPEATED + 0.05)
        with pytest.raises(signals.Interrupted, match="SIGTERM"):
            os.kill(os.getpid(), signal.SIGINT)


def test_what_nohup_ignores_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with raising_signals():
            os.kill(os.getpid(), signal.SIGHUP)
            assert signals.arrived() is None
    finally:
        signal.signal(signal.SIGHUP, before)


class Deaf:
    """What is raised in a destructor, Python drops."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


def test_a_signal_that_python_drops_ends_the_run_all_the_same(store_folder: Path) -> None:
    settings = config.load(["preset=smoke"])
    data = DemonstrationData(settings)
    with (
        raising_signals(),
        pytest.raises(signals.Interrupted, match="SIGTERM"),
        recording.start(experiment(settings, data)),
    ):
        Deaf()
    assert [run.info.status for run in store.runs()] == ["KILLED"]


def test_long_work_notices_a_signal_that_python_dropped(capsys: pytest.CaptureFixture[str]) -> None:
    with raising_signals(), ProgressDisplay(Console(file=io.StringIO())) as display:
        task = display.add("training", 10)
        display.update(task, 1)
        Deaf()
        with pytest.raises(signals.Interrupted, match="SIGTERM"):
            display.update(task, 2)
    assert capsys.readouterr().err == ""  # no traceback of it beside the one line that says so


def test_a_signal_of_which_a_library_makes_another_error_ends_the_run_as_interrupted(store_folder: Path) -> None:
    settings = config.load(["preset=smoke"])
    data = DemonstrationData(settings)

    def drawn() -> None:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except BaseException:
            raise ValueError("Invalid affine transformation matrix") from None

    with (
        raising_signals(),
        pytest.raises(ValueError, match="Invalid affine"),
        recording.start(experiment(settings, data)),
    ):
        drawn()
    assert [run.info.status for run in store.runs()] == ["KILLED"]


def test_a_run_is_found_by_its_id_its_name_or_its_preset_and_name(store_folder: Path) -> None:
    """At another preset a run has the same name; the newest is meant, unless the preset is named."""
    client = store.client()
    experiment = client.get_experiment_by_name(store.EXPERIMENT)
    assert experiment is not None
    made: dict[str, str] = {}
    for preset in ("quick", "long"):
        run = client.create_run(experiment.experiment_id, run_name="cgp-s0", tags={"preset": preset})
        client.set_terminated(run.info.run_id, "FINISHED")
        made[preset] = str(run.info.run_id)
    wanted = {
        "quick/cgp-s0": "quick",
        "long/cgp-s0": "long",
        "cgp-s0": "long",
        "latest": "long",
        made["quick"]: "quick",
    }
    assert {name: str(store.find_run(name).info.run_id) for name in wanted} == {
        name: made[preset] for name, preset in wanted.items()
    }
    with pytest.raises(errors.ConfigError, match="run=paper/cgp-s0: no such finished run"):
        store.find_run("paper/cgp-s0")


def test_an_interrupted_run_is_found_although_one_of_its_name_has_finished_since(store_folder: Path) -> None:
    client = store.client()
    experiment = client.get_experiment_by_name(store.EXPERIMENT)
    assert experiment is not None
    made: list[str] = []
    for preset, status in (("long", "KILLED"), ("long", "KILLED"), ("quick", "KILLED"), ("smoke", "FINISHED")):
        tags = {"preset": preset, "config_sha": f"of {preset}"}
        run = client.create_run(experiment.experiment_id, run_name="cgp-s0", tags=tags)
        client.set_terminated(run.info.run_id, status)
        made.append(str(run.info.run_id))

    def found(asked: str) -> dict[str, int]:
        names = ("long/cgp-s0", "quick/cgp-s0", "cgp-s0", "latest", made[0])
        return {name: made.index(str(resume.find(name, asked).info.run_id)) for name in names}

    newest = {"long/cgp-s0": 1, "quick/cgp-s0": 2, "cgp-s0": 2, "latest": 2, made[0]: 0}
    assert found("of quick") == newest
    assert found("of paper") == newest
    # What was asked for goes before what is newer: two that trained side by side are resumed with "latest".
    assert found("of long") == newest | {"cgp-s0": 1, "latest": 1}
    for ended in ("smoke/cgp-s0", made[3]):
        with pytest.raises(errors.ConfigError, match="expected an interrupted run, found one that is FINISHED"):
            resume.find(ended, "of smoke")
    with pytest.raises(errors.ConfigError, match=r"resume=logn/cgp-s0: no such run.*did you mean long/cgp-s0\?"):
        resume.find("logn/cgp-s0", "of long")


def interrupted(data: DemonstrationData) -> Run:
    """A run that has failed after some writes."""

    def fail() -> None:
        with recording.start(experiment(data.config, data)) as logger:
            logger.save()
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    return store.runs()[0]


def test_the_hours_between_an_interruption_and_its_resumption_are_no_work(store_folder: Path) -> None:
    data = DemonstrationData(config.load(["preset=smoke"]))
    run = interrupted(data)
    before = recording.at_work(run)
    time.sleep(1.5)
    start = time.monotonic()
    with recording.start(experiment(data.config, data), run):
        time.sleep(0.2)
    elapsed = time.monotonic() - start
    (run,) = store.runs("FINISHED")
    assert before + 0.2 <= recording.at_work(run) <= before + elapsed + 2e-3  # two are rounded
    assert recording.at_work(run) < (run.info.end_time - run.info.start_time) / 1000 - 1.4
    assert Record.of(run).seconds == recording.at_work(run)


def test_a_killed_run_was_at_work_until_its_last_write(store_folder: Path) -> None:
    """Not until a later command found it gone, which is what the store takes for its end."""
    data = DemonstrationData(config.load(["preset=smoke"]))
    run = interrupted(data)
    client = store.client()
    client.set_terminated(run.info.run_id, "KILLED", end_time=run.info.start_time + 3_600_000)
    assert recording.at_work(client.get_run(run.info.run_id)) < 60
    client.delete_tag(run.info.run_id, "seconds")  # as one of before there was it
    assert recording.at_work(client.get_run(run.info.run_id)) == 3600


def test_sampling_a_run_again_is_no_work_of_its_training(store_folder: Path) -> None:
    data = DemonstrationData(config.load(["preset=smoke"]))
    with recording.start(experiment(data.config, data)):
        pass
    (run,) = store.runs()
    time.sleep(0.1)
    logger = recording.RunLogger(store.client(), run.info.run_id)
    logger.log_metrics({"evaluate/same settings/none/num": 1})
    logger.save()
    assert store.runs()[0].data.tags["seconds"] == run.data.tags["seconds"]


@pytest.mark.parametrize(("note", "kept"), [(liveness.GONE, None), ("Mine.", "Mine.")])
def test_a_run_that_goes_on_is_no_longer_said_to_be_gone(note: str, kept: str | None, store_folder: Path) -> None:
    data = DemonstrationData(config.load(["preset=smoke"]))
    run = interrupted(data)
    store.client().set_tag(run.info.run_id, liveness.NOTE, note)
    with recording.start(experiment(data.config, data), store.runs()[0]):
        assert store.runs()[0].data.tags.get(liveness.NOTE) == kept
    assert store.runs()[0].data.tags.get(liveness.NOTE) == kept


def test_a_run_goes_on_with_other_code_only_where_that_is_asked_for(
    store_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = DemonstrationData(config.load(["preset=smoke"]))
    run = interrupted(data)
    assert run.data.tags["code_sha"] == code.tags()["code_sha"]
    resume.check(run, experiment(data.config, data))
    monkeypatch.setattr(code, "files", other_correction())
    with pytest.raises(errors.ConfigError, match=r"resume=cgp-s0: found other code in flow/correction.py, .*code=any"):
        resume.check(run, experiment(data.config, data))
    resume.check(run, experiment(data.config, data), any_code=True)
    with recording.start(experiment(data.config, data), run):
        pass
    tags = store.runs()[0].data.tags
    assert tags["code_sha"] not in (run.data.tags["code_sha"], code.tags()["code_sha"]), "it is of neither"
    assert code.differing(tags) == ["flow/correction.py"]
    store.client().delete_tag(run.info.run_id, "code")  # as a run of before there was it
    with pytest.raises(errors.ConfigError, match="found other code in unknown files"):
        resume.check(store.runs()[0], experiment(data.config, data))


@pytest.mark.parametrize(("status", "resumes"), [("FINISHED", False), ("KILLED", True)])
def test_a_grid_knows_its_cells_by_their_code_too(
    status: str, resumes: bool, store_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = DemonstrationData(config.load(["preset=smoke"]))
    run = interrupted(data)
    store.client().set_terminated(run.info.run_id, status)

    def seen(any_code: bool) -> tuple[bool, list[str], str]:
        cell = Job([], data.config)
        return finished(cell, any_code), cell.resume, cell.again

    again = [f"resume={run.info.run_id}"]
    assert seen(any_code=False) == (not resumes, again if resumes else [], "")
    monkeypatch.setattr(code, "files", other_correction())
    assert seen(any_code=False) == (False, [], "trained by other code: flow/correction.py")
    assert seen(any_code=True) == (not resumes, [*again, "code=any"] if resumes else [], "")
    store.client().delete_tag(run.info.run_id, "code")
    assert seen(any_code=False) == (False, [], "trained by other code: unknown files")


def test_labels_that_are_inverted_in_the_file_make_another_cell(store_folder: Path) -> None:
    x, labels = swap(200).numpy(), np.arange(200) % 3 == 0
    np.savez("mine.npz", x=x, violates=labels)
    settings = config.load(["preset=smoke", "data.path=mine.npz"])
    with recording.start(experiment(settings, DemonstrationData(settings))):
        pass
    assert finished(Job([], settings), any_code=False)
    np.savez("mine.npz", x=x, violates=~labels)
    assert not finished(Job([], settings), any_code=False)


def other_correction() -> Callable[[], Mapping[str, str]]:
    """`code.files` of a program whose flow/correction.py is another."""
    files = dict(code.files()) | {"flow/correction.py": "00000000"}
    return lambda: files
