"""Checkpoints are whole or not there: full disks, broken files, and files that are not ours."""

import errno
import os
import pickle
import subprocess
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from conflow.tracking import checkpoint_file, checkpoints
from conflow.tracking.checkpoint_file import CheckpointError
from conflow.tracking.checkpoints import AtomicCheckpointIO
from tests.faults import processes
from tests.faults.processes import history, runs, weights

TRAIN = (
    *("train", "preset=smoke", "data.num=200", "train.max_steps=30", "train.val_every=5", "train.batch_size=16"),
    *("sample.num=8", "sample.steps=3"),
)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own, of 1 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def checkpoint(number: int, size: int = 50_000) -> dict[str, object]:
    """Of about 4 `size` bytes."""
    return {"conflow": {}, "loops": {}, "number": number, "weights": torch.rand(size)}


def test_the_newest_checkpoint_and_the_one_before_are_kept(tmp_path: Path) -> None:
    io = AtomicCheckpointIO()
    for number in range(3):
        io.save_checkpoint(checkpoint(number), tmp_path / checkpoints.LAST)
    assert sorted(path.name for path in tmp_path.iterdir()) == [checkpoints.LAST, checkpoints.PREVIOUS]
    assert checkpoint_file.load(tmp_path / checkpoints.LAST)["number"] == 2
    assert checkpoint_file.load(tmp_path / checkpoints.PREVIOUS)["number"] == 1


def test_two_writers_of_a_checkpoint_leave_a_whole_one_at_any_time(tmp_path: Path) -> None:
    path = tmp_path / checkpoints.LAST
    errors: list[BaseException] = []

    def write(number: int) -> None:
        try:
            for _ in range(40):
                content = {"conflow": {}, "loops": {}, "w": torch.full((50_000,), number)}
                AtomicCheckpointIO().save_checkpoint(content, path)
        except BaseException as error:
            errors.append(error)

    writers = [threading.Thread(target=write, args=(number,)) for number in (1, 2)]
    for writer in writers:
        writer.start()
    seen = 0
    while any(writer.is_alive() for writer in writers):
        for name in (checkpoints.LAST, checkpoints.PREVIOUS):
            try:
                found = checkpoint_file.load(tmp_path / name)["w"]
            except FileNotFoundError:
                continue
            assert bool((found == found[0]).all())
            seen += 1
    assert errors == []
    assert seen > 0
    assert sorted(file.name for file in tmp_path.iterdir()) == [checkpoints.LAST, checkpoints.PREVIOUS]


def test_a_full_disk_leaves_the_checkpoint_that_was_there_and_nothing_else(disk: Path) -> None:
    io = AtomicCheckpointIO()
    path = disk / checkpoints.LAST
    io.save_checkpoint(checkpoint(0), path)
    (disk / "others").write_bytes(bytes(700_000))
    with pytest.raises(CheckpointError) as refused:
        io.save_checkpoint(checkpoint(1), path)
    assert str(refused.value) == (
        f"{path}: expected to write a checkpoint, found {os.strerror(errno.ENOSPC)}; kept the one before it, {path}"
    )
    assert sorted(file.name for file in disk.iterdir()) == [checkpoints.LAST, "others"]
    assert checkpoint_file.load(path)["number"] == 0


def test_a_training_that_fills_the_disk_ends_in_one_line_and_goes_on_when_there_is_room(disk: Path) -> None:
    whole = disk.with_name("whole")
    whole.mkdir()
    code, output = processes.run(whole, *TRAIN)
    assert code == 0, output
    folder = disk.with_name("work")
    folder.mkdir()
    (folder / "runs").mkdir()
    (folder / "runs" / "checkpoints").symlink_to(disk)
    (disk / "others").write_bytes(bytes(2**20 - 450_000))  # room for three checkpoints of 150 KB, but not quite
    code, output = processes.run(folder, *TRAIN)
    assert code == 2, output
    (said,) = [line for line in output.splitlines() if line.startswith("conflow:")]
    assert "expected to write a checkpoint, found No space left on device; kept the one before it" in said
    assert runs(folder)[0].info.status == "FAILED"
    (disk / "others").unlink()
    code, output = processes.run(folder, *TRAIN, "resume=latest")
    assert code == 0, output
    (expected,), (found,) = runs(whole), runs(folder)
    assert all(torch.equal(tensor, weights(expected)[name]) for name, tensor in weights(found).items())
    assert history(folder, found) == history(whole, expected)


@pytest.mark.parametrize("kept", [0, 1, 100, 0.5, 0.999])
def test_a_truncated_checkpoint_is_refused_by_name(kept: float, tmp_path: Path) -> None:
    path = tmp_path / checkpoints.LAST
    AtomicCheckpointIO().save_checkpoint(checkpoint(0), path)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if isinstance(kept, float) else kept])
    with pytest.raises(CheckpointError, match=r"last\.ckpt: expected a checkpoint of ConFlow, found a damaged"):
        checkpoint_file.load(path)


def test_a_foreign_file_is_refused_by_name(tmp_path: Path) -> None:
    for name, content in {"text": b"hello", "pickle": pickle.dumps({"conflow": {}})}.items():
        (tmp_path / name).write_bytes(content)
    with zipfile.ZipFile(tmp_path / "zip", "w") as archive:
        archive.writestr("data", "hello")
    torch.save({"weights": torch.ones(3)}, tmp_path / "torch")
    torch.save([1, 2], tmp_path / "list")
    for name in ("text", "pickle", "zip", "torch", "list"):
        with pytest.raises(CheckpointError, match=rf"{name}: expected a checkpoint of ConFlow"):
            checkpoint_file.load(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        checkpoint_file.load(tmp_path / "missing")


class Bomb:
    """Unpickling it leaves a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.path),)


def test_loading_a_checkpoint_runs_no_code_from_it(tmp_path: Path) -> None:
    bomb = tmp_path / checkpoints.LAST
    torch.save({"conflow": {}, "loops": Bomb(tmp_path / "exploded")}, bomb)
    torch.load(bomb, weights_only=False)  # it is a live one
    (tmp_path / "exploded").rmdir()
    with pytest.raises(CheckpointError):
        checkpoint_file.load(bomb)
    with pytest.raises(CheckpointError):
        AtomicCheckpointIO().load_checkpoint(bomb, weights_only=False)
    assert checkpoints.newest(tmp_path)[0] is None
    assert not (tmp_path / "exploded").exists()


def test_a_model_alone_is_no_state_to_go_on_from(tmp_path: Path) -> None:
    AtomicCheckpointIO().save_checkpoint({"conflow": {}}, tmp_path / checkpoints.LAST)
    path, _, refused = checkpoints.newest(tmp_path)
    assert path is None
    assert "found a model alone" in refused[0]
