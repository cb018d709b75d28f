"""Bad input of every kind: one line that names the setting, its value and what was expected, and nothing left behind.

The faults are real: damaged files, a folder where a file should be, a full disk, a port that is taken, a broken store.
"""

import io
import os
import resource
import shutil
import socket
import sqlite3
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from conflow.errors import ConfigError
from conflow.planner import PlanError, Planner
from conflow.scene.settings import Obstacle
from conflow.training import config
from conflow.training.model_file import MODEL_FILE
from tests.faults.conftest import RUN, Run, assert_refused, listing
from tests.papers import model_of

HUGE = "1" + "0" * 400
PAIR = ("start=-0.8,0,0.8,0", "goal=0.8,0,-0.8,0")
ABLATIONS = ", ".join(config.names("ablation"))
WHOLE, FINITE = "expected a whole number", "expected a finite number"

# An argument of `train`, and what is said of it.
SETTINGS = [
    ("seed", "seed: expected key=value"),
    ("", ": expected key=value"),
    ("=3", ": no such setting"),
    ("sée=1", "sée: no such setting, expected one of conf/base.yaml"),
    ("Seed=1", "Seed: no such setting, expected one of conf/base.yaml; did you mean seed?"),
    ("data=3", "data: no such setting"),
    ("\udcff=3", r"\udcff: no such setting"),
    ("a" * 100_000 + "=1", "aaa...: no such setting"),
    ("seed=", "seed=: expected a whole number"),
    ("seed=null", f"seed=null: {WHOLE}"),
    ("seed=true", f"seed=true: {WHOLE}"),
    ("seed=2.5", f"seed=2.5: {WHOLE}"),
    ("seed=[1]", f"seed=[1]: {WHOLE}"),
    ("seed={a: 1}", f"seed={{a: 1}}: {WHOLE}"),
    ("seed=1:30", f"seed=1:30: {WHOLE}"),
    ("seed=&a 3", f"seed=&a 3: {WHOLE}"),
    ("seed=3 # ../../x", f"seed=3 # ../../x: {WHOLE}"),
    ("seed=!!python/object/apply:os.system [touch x]", f"seed=!!python/object/apply:os.system [touch x]: {WHOLE}"),
    ("seed=???", f"seed=???: {WHOLE}"),
    ("seed=${data.seed}", f"seed=${{data.seed}}: {WHOLE}"),
    ("seed=1\n2", f"seed=1 2: {WHOLE}"),
    ("seed=1\u20282", f"seed=1 2: {WHOLE}"),
    ("seed=\x1b[31m", rf"seed=\x1b[31m: {WHOLE}"),
    ("seed=\udcff", rf"seed=\udcff: {WHOLE}"),
    ("seed=-1", f"seed=-1: {WHOLE} of at least 0 and at most 4294967295"),
    ("seed=4294967296", f"seed=4294967296: {WHOLE} of at least 0 and at most 4294967295"),
    (f"seed={HUGE}", f"...: {WHOLE} of at least 0 and at most 4294967295"),
    (f"seed={'1' * 5000}", f"seed={'1' * 57}...: {WHOLE}"),
    (f"seed=0x{'f' * 5000}", f"seed=0x{'f' * 55}...: {WHOLE}"),
    ("seed=" + "{" * 5000, f"...: {WHOLE}"),
    (f"seed={'a' * 100_000}", f"seed={'a' * 57}...: {WHOLE}"),
    ("ablation=cpg", f"ablation=cpg: expected one of {ABLATIONS}; did you mean cgp?"),
    ("ablation=", f"ablation=: expected one of {ABLATIONS}"),
    ("ablation=${preset}", "ablation=${preset}: expected one of"),
    ("preset=../preset/smoke", "preset=../preset/smoke: expected one of long, paper, quick, smoke"),
    ("preset=SMOKE", "preset=SMOKE: expected one of long, paper, quick, smoke"),
    ("data.num=9", f"data.num=9: {WHOLE} of at least 10 and at most 100000000"),
    ("data.num=1e3", f"data.num=1e3: {WHOLE}"),
    (f"data.num={HUGE}", f"...: {WHOLE} of at least 10"),
    ("data.horizon=2", f"data.horizon=2: {WHOLE} of at least 3 and at most 4096"),
    ("data.amplitudes=[nan]", "data.amplitudes=[nan]: expected [a, b, ...] of at most 64 numbers of at least 0"),
    ("data.amplitudes=[[1]]", "data.amplitudes=[[1]]: expected [a, b, ...] of at most 64 numbers"),
    ("data.amplitudes=[true]", "data.amplitudes=[true]: expected [a, b, ...]"),
    ("data.amplitudes=[${seed}]", "data.amplitudes=[${seed}]: expected [a, b, ...]"),
    ("data.amplitudes=null", "data.amplitudes=null: expected [a, b, ...]"),
    (f"data.amplitudes={[0.1] * 2000}", "...: expected [a, b, ...] of at most 64 numbers"),
    ("data.amplitudes=" + "[" * 1100, "...: expected [a, b, ...]"),
    ("data.jitter=-0.1", f"data.jitter=-0.1: {FINITE} of at least 0 and at most 0.2"),
    ("data.path=${oc.env:HOME}", "data.path=${oc.env:HOME}: expected a text without ${, or null"),
    ("data.negatives=maybe", "data.negatives=maybe: expected true or false"),
    ("data.negatives=2", "data.negatives=2: expected true or false"),
    ("data.negative_share=1.5", f"data.negative_share=1.5: {FINITE} or null of at least 0 and at most 1"),
    ("data.val_fraction=1", "expected less than 1 together with data.val_fraction=1.0"),
    ("source.kind=[cgp]", "source.kind=[cgp]: expected one of gaussian, gp, cgp"),
    ("source.length_scale=1e-300", f"source.length_scale=1e-300: {FINITE} of at least 1e-06 and at most 1000000"),
    ("source.length_scale=1e300", f"source.length_scale=1e+300: {FINITE} of at least 1e-06 and at most 1000000"),
    ("source.sigma_f=0", f"source.sigma_f=0.0: {FINITE} of at least"),
    ("source.epsilon=1e300", f"source.epsilon=1e+300: {FINITE} of at least 1e-12"),
    ("source.modes=4097", f"source.modes=4097: {WHOLE} or null of at least 1 and at most 4096"),
    ("constraint.radius=0", f"constraint.radius=0.0: {FINITE} above 0 and at most 2"),
    ("constraint.gamma=1e300", f"constraint.gamma=1e+300: {FINITE}"),
    ("correction.sigma=1e-300", f"correction.sigma=1e-300: {FINITE}"),
    ("correction.width=999999999", f"correction.width=999999999: {WHOLE} of at least 1 and at most 8191"),
    ("correction.lambda_c=-1", f"correction.lambda_c=-1.0: {FINITE} of at least 0"),
    ("correction.lambda_c=1e300", f"correction.lambda_c=1e+300: {FINITE} of at least 0 and at most 1000000000"),
    ("correction.edges=round", "correction.edges=round: expected one of zero, nearest, normalised"),
    ("network.hidden=65537", f"network.hidden=65537: {WHOLE} of at least 1 and at most 65536"),
    ("network.blocks=-1", f"network.blocks=-1: {WHOLE} of at least 0 and at most 1024"),
    ("train.lr=nan", f"train.lr=nan: {FINITE}"),
    ("train.lr=-.inf", f"train.lr=-inf: {FINITE} above 0"),
    ("train.lr=1e400", f"train.lr=inf: {FINITE} above 0"),
    ("train.lr=1e-400", f"train.lr=0.0: {FINITE} above 0"),
    (f"train.lr={HUGE}", f"...: {FINITE}"),
    ("train.max_steps=0", f"train.max_steps=0: {WHOLE} of at least 1"),
    ("train.max_steps=${foo}", f"train.max_steps=${{foo}}: {WHOLE}"),
    ("train.batch_size=10000000000", f"train.batch_size=10000000000: {WHOLE} of at least 1 and at most 1000000000"),
    ("train.accelerator=cuda", "train.accelerator=cuda: expected one of auto, cpu, gpu, mps"),
    ("train.accelerator=mps", "train.accelerator=mps: not on this machine, expected one of auto, cpu"),
    (f"sample.num={HUGE}", f"...: {WHOLE} of at least 2 and at most 1000000000"),
    ("sample.obstacle={x: 1}", "sample.obstacle: no such setting"),
    ("sample.obstacle.x=1e39", f"sample.obstacle.x=1e+39: {FINITE} of at least -2 and at most 2"),
    ("sample.obstacle.radius=-1", f"sample.obstacle.radius=-1.0: {FINITE} above 0 and at most 2"),
    ("sample.radius=3", f"sample.radius=3.0: {FINITE} or null above 0 and at most 2"),
]


@pytest.mark.parametrize(("argument", "said"), SETTINGS, ids=range(len(SETTINGS)))
def test_a_bad_setting(argument: str, said: str, command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # Were it accepted, the missing file would stop the training.
    assert_refused(command("train", argument, "data.path=missing.npz"), said)
    assert not listing(tmp_path)


GIB = " GiB of memory or more, expected what fits into the "
TOO_LARGE = [
    (("data.num=100000000", "data.horizon=4096"), "data.num=100000000: takes 24415"),
    (("network.hidden=65536", "network.blocks=1024"), "network.blocks=1024, network.hidden=65536: takes 131"),
    (("train.batch_size=1000000000",), "train.batch_size=1000000000: takes "),
    (("sample.num=1000000000",), "sample.num=1000000000: takes 5723"),
]


@pytest.mark.parametrize(("arguments", "said"), TOO_LARGE)
def test_what_cannot_fit_into_memory_is_refused_before_it_is_made(
    arguments: tuple[str, ...], said: str, command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(command("train", "preset=smoke", *arguments), said, GIB)
    assert not listing(tmp_path)


@contextmanager
def limited(kind: int, to: int) -> Iterator[None]:
    """Less of a resource for this process."""
    soft, hard = resource.getrlimit(kind)
    resource.setrlimit(kind, (to, hard))
    try:
        yield
    finally:
        resource.setrlimit(kind, (soft, hard))


def test_memory_that_the_system_refuses(command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two million trajectories fit into the machine but not into what is left to the process."""
    monkeypatch.chdir(tmp_path)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    with limited(resource.RLIMIT_AS, used + 2**28):
        outcome = command("train", "preset=smoke", "data.num=2000000")
    assert_refused(outcome, "memory: ", "expected a smaller network, batch, or number of trajectories")
    assert not listing(tmp_path)


X = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 8, 4)).astype(np.float32)


def spoiled(value: float) -> np.ndarray[Any, Any]:
    x = X.copy()
    x[3, 2, 1] = value
    return x


def written(**arrays: Any) -> bytes:
    """The .npz file of some arrays."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def zipped(name: str, content: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, content)
    return file.getvalue()


def claiming(*shape: int) -> bytes:
    """A file that announces an array of this shape and holds nothing."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return zipped("x.npy", header.getvalue())


NUMERIC = "expected an .npz file with numeric arrays"
SHAPE = "expected (N, T, D) with"
# What is in the file of demonstrations, and what is said of it.
FILES: dict[str, tuple[bytes, str]] = {
    "truncated": (written(x=X)[:3000], NUMERIC),
    "empty": (b"", NUMERIC),
    "text": (b"x,y\n1,2\n", NUMERIC),
    "zip without arrays": (zipped("notes.txt", b"x"), "expected an array named x of shape (N, T, D)"),
    "no array in x.npy": (zipped("x.npy", b"hello"), "x holds |S5, expected floating-point numbers"),
    "no array in x": (zipped("x", b"hello"), "x holds |S5, expected floating-point numbers"),
    "one array, no archive": (b"\x93NUMPY\x01\x00", NUMERIC),
    "header that never ends": (zipped("x.npy", b"\x93NUMPY\x02\x00\xff\xff\xff\xff{"), NUMERIC),
    "larger than memory": (claiming(10**9, 4096, 4), "expected arrays that fit into memory"),
    "larger than numbers": (claiming(2**40, 2**40, 4), "expected an"),
    "another key": (written(y=X), "expected an array named x of shape (N, T, D)"),
    "nan": (
        written(x=spoiled(np.nan)),
        "1 trajectories hold NaN or infinity, the first is 3, expected finite numbers",
    ),
    "inf": (
        written(x=spoiled(-np.inf)),
        "1 trajectories hold NaN or infinity, the first is 3, expected finite",
    ),
    "outside": (
        written(x=spoiled(1.5)),
        "1 trajectories leave the workspace [-1, 1], the first is 3, found -0.4998 to 1.5",
    ),
    "beyond float32": (written(x=X.astype(np.float64) * 1e300), "50 trajectories hold NaN or infinity"),
    "rank 0": (written(x=np.float32(1)), f"x has shape (), {SHAPE}"),
    "rank 2": (written(x=X[0]), f"x has shape (8, 4), {SHAPE}"),
    "rank 4": (written(x=X[None]), f"x has shape (1, 50, 8, 4), {SHAPE}"),
    "odd D": (written(x=X[:, :, :3]), f"x has shape (N, 8, 3), {SHAPE}"),
    "one robot": (written(x=X[:, :, :2]), f"x has shape (N, 8, 2), {SHAPE}"),
    "two waypoints": (written(x=X[:, :2]), f"x has shape (50, 2, 4), {SHAPE}"),
    "no trajectory": (written(x=X[:0]), "x is empty, expected at least one trajectory"),
    "one trajectory": (written(x=X[:1]), "no trajectory for training is feasible out of 1, and ablation cgp needs D+"),
    "three trajectories": (
        written(x=X[:3], violates=np.array([True, False, False])),
        "0 trajectories are left for validation out of 3, expected 1 or more",
    ),
    "ten trajectories": (
        written(x=X[:10], violates=np.arange(10) % 2 == 0),
        "1 trajectories are left for test out of 10, expected 2 or more",
    ),
    "objects": (written(x=np.array([{1: 2}], dtype=object)), NUMERIC),
    "complex": (written(x=X * 1j), "x holds complex64, expected floating-point numbers"),
    "integers": (written(x=(X * 1e18).astype(np.int64)), "x holds int64, expected floating-point numbers"),
    "strings": (written(x=X.astype(str)), "x holds <U32, expected floating-point numbers"),
    "booleans": (written(x=X > 0), "x holds bool, expected floating-point numbers"),
    "records": (written(x=np.zeros(3, [("a", "f4")])), "expected floating-point numbers"),
    "too few labels": (written(x=X, violates=np.ones(49, bool)), "bool of shape (49,), expected bool of shape (50,)"),
    "labels of rank 2": (written(x=X, violates=np.ones((50, 1), bool)), "expected bool of shape (50,)"),
    "labels as numbers": (written(x=X, violates=np.ones(50)), "violates holds float64 of shape (50,), expected bool"),
    "labels as objects": (written(x=X, violates=np.array([None] * 50)), NUMERIC),
    "labels as text": (zipped("x.npy", b"") + b"junk", "expected"),
    "none violates": (written(x=X, violates=np.zeros(50, bool)), "no trajectory for training violates the constraint"),
    "all violate": (
        written(x=X, violates=np.ones(50, bool)),
        "no trajectory for training is feasible out of 40, and ablation cgp needs D+",
    ),
}


@pytest.mark.parametrize("what", FILES)
def test_a_bad_file_of_demonstrations(what: str, command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    content, said = FILES[what]
    Path("bad.npz").write_bytes(content)
    before = listing(tmp_path)
    assert_refused(command("train", "preset=smoke", "data.path=bad.npz"), "data.path=bad.npz: ", said)
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    "path",
    [
        "missing.npz",
        "folder.npz",
        "text.npz/x.npz",
        "loop.npz",
        "dangling.npz",
        "pipe.npz",
        "/dev/zero",
        "/proc/self/mem",
        "/proc/no/x.npz",
        "new\nline.npz",
        "☃.npz",
        f"{'x' * 300}.npz",
    ],
)
def test_a_path_without_a_file(path: str, command: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("folder.npz").mkdir()
    Path("text.npz").write_text("x")
    Path("loop.npz").symlink_to("loop.npz")
    Path("dangling.npz").symlink_to("nowhere.npz")
    os.mkfifo("pipe.npz")
    before = listing(tmp_path)
    said = f"data.path={' '.join(path.split())}: "
    assert_refused(command("train", "preset=smoke", f"data.path={path}"), said, NUMERIC)
    assert listing(tmp_path) == before


OUTPUTS = [
    ("", "expected a name that ends in .npz"),
    ("plans", "expected a name that ends in .npz"),
    (".npz", "expected a name that ends in .npz"),
    ("old.npz", "expected a new file"),
    ("folder.npz", "expected a new file"),
    ("missing/plans.npz", "expected "),
    ("old.npz/plans.npz", "expected "),
    ("/proc/plans.npz", "expected a new file"),
    ("/dev/null/plans.npz", "expected "),
    (f"{'x' * 300}.npz", "File name too long, expected a new file"),
]


@pytest.mark.parametrize("arguments", [("demonstrations", "num=10"), ("sample", f"run=./{MODEL_FILE}", *PAIR, "num=2")])
@pytest.mark.parametrize(("out", "said"), OUTPUTS)
def test_an_output_that_cannot_be_written(
    arguments: tuple[str, ...],
    out: str,
    said: str,
    command: Run,
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(trained / MODEL_FILE, tmp_path)
    Path("old.npz").write_text("precious")
    Path("folder.npz").mkdir()
    before = listing(tmp_path)
    assert_refused(command(*arguments, f"out={out}"), f"out={out}: ", said)
    assert listing(tmp_path) == before


@pytest.mark.parametrize("command_name", ["demonstrations", "sample"])
def test_a_disk_that_is_full_half_way(
    command_name: str, command: Run, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files may not grow beyond 2,000 bytes, which are fewer than the arrays and than the picture take."""
    monkeypatch.chdir(tmp_path)
    arguments = ("num=1000",) if command_name == "demonstrations" else (f"run={trained / MODEL_FILE}", *PAIR, "num=2")
    with limited(resource.RLIMIT_FSIZE, 2000):
        outcome = command(command_name, *arguments, "out=new.npz")
    assert_refused(outcome, "out=new.npz: File too large, expected a new file")
    assert not listing(tmp_path)


def test_a_picture_that_cannot_be_written_takes_the_plans_with_it(
    command: Run, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("plans.png").symlink_to("/proc/nowhere.png")  # of which nothing exists until it is written
    outcome = command("sample", f"run={trained / MODEL_FILE}", *PAIR, "num=2")
    assert_refused(outcome, "out=plans.npz: ", "expected a new file")
    assert list(listing(tmp_path)) == ["plans.png"]


OPTIONS = [
    (("demonstrations", "num=9"), f"num=9: {WHOLE} of at least 10 and at most 100000"),
    (("demonstrations", f"num={HUGE}"), f"...: {WHOLE}"),
    (("demonstrations", f"seed={'1' * 5000}"), f"...: {WHOLE}"),
    (("demonstrations", "num=²"), f"num=²: {WHOLE}"),
    (
        ("demonstrations", "sed=1"),
        "sed: no such option, expected task, from, out, num, seed, agents, seconds, T, fps, opposite, near",
    ),
    (("demonstrations", "seed\n=x"), f"seed=x: {WHOLE}"),
    (("sample", "goal=0.8,0,-0.8,0"), "start: expected the robots' positions, found none"),
    (("sample", "start=a,b", "goal=0,0"), "start=a,b: expected numbers with commas between"),
    (("sample", "start=0,0", "goal=0,0"), "start=[0.0, 0.0]: found shape (2,), expected numbers of shape (4,)"),
    (("sample", "start=nan,0,0.8,0", "goal=0.8,0,-0.8,0"), "start=(nan, 0, 0.8, 0): expected finite numbers"),
    (("sample", "start=1e400,0,0.8,0", "goal=0.8,0,-0.8,0"), "start=(inf, 0, 0.8, 0): expected finite numbers"),
    (("sample", "start=0,0,0,0", "goal=0.8,0,-0.8,0"), "start=(0, 0, 0, 0): violates robot by 0.3, expected"),
    (("sample", f"start={'0,' * 9999}0", "goal=0.8,0,-0.8,0"), "...: found shape (10000,), expected"),
    (("sample", *PAIR, "obstacle=0,0"), "obstacles[0]=[0.0, 0.0]: found shape (2,), expected"),
    (("sample", *PAIR, "obstacle=0,0.5,-1"), "obstacles[0]=(0, 0.5, -1): expected finite numbers and a radius above 0"),
    (("sample", *PAIR, "obstacle=0,1e39,1"), "obstacles[0]=(0, inf, 1): expected finite numbers"),
    (("sample", *PAIR, "num=0"), f"num=0: {WHOLE} of at least 1 and at most 1000000"),
    (("sample", *PAIR, "guidance=robbot"), "guidance=robbot: expected one of none, all, robot, obstacle; did you mean"),
    (
        ("sample", *PAIR, "run=cpg-s0"),
        "run=cpg-s0: no such finished run, expected latest, an id, NAME or PRESET/NAME; did",
    ),
    (("sample", *PAIR, "run="), "run=: no such finished run, expected latest, an id, NAME or PRESET/NAME"),
    (("sample", *PAIR, "run=./none.ckpt"), f"run=./none.ckpt: no such file, expected the {MODEL_FILE} of a run"),
    (("sample", *PAIR, "run=/dev/null/x.ckpt"), f"expected the {MODEL_FILE} of a run"),
    (("evaluate", "run=nobody"), "run=nobody: no such finished run, expected latest, an id, NAME or PRESET/NAME"),
    (("evaluate", "train.lr=1"), "train.lr=1: fixed by the run, expected settings of sample. and seed only"),
    (("evaluate", "sample.steps=0"), f"sample.steps=0: {WHOLE} of at least 1"),
    (("evaluate", "sample.num=1000000000"), f"sample.num=1000000000: takes 5723{GIB}"),
    (("evaluate", "seed=3 # ../../x"), f"seed=3 # ../../x: {WHOLE}"),
    (("compare", "format=xml"), "format=xml: expected one of table, markdown, csv, json"),
    (("compare", "preset=it's"), "preset=it's: expected one of long, paper, quick, smoke"),
    (("compare", "preset=paper"), "preset=paper: no such run has finished in runs/mlflow.db"),
    (("compare", "train.lr=fast"), f"train.lr=fast: {FINITE}"),
    (("train", "preset=smoke", "code=some"), "code=some: expected same or any"),
    (("ablations", "preset=smoke", "code="), "code=: expected same or any"),
    (("figures", "run=nobody"), "run=nobody: no such finished run, expected"),
    (("figures", "rnu=latest"), "rnu: no such option, expected run, split, task; did you mean run?"),
    *(
        ((of_runs, "split=train"), "split=train: expected val or test")
        for of_runs in ("evaluate", "compare", "figures")
    ),
    (("ablations", "split="), "split=: expected val or test"),
    (("compare", "reference=1", "split=val"), "split=val: expected test with reference=1"),
    (("explain", "preset=quik"), "preset=quik: expected one of long, paper, quick, smoke; did you mean quick?"),
    (("ablations", "jobs=0"), f"jobs=0: {WHOLE} of at least 1 and at most 1024"),
    (("ablations", "seeds=0 x"), f"seed=x: {WHOLE}"),
    (("ablations", "seeds= "), "seeds=: expected at least one"),
    (("ablations", "ablations="), "ablations=: expected at least one"),
    (("ablations", "ablations=cgp cpg"), "ablation=cpg: expected one of"),
    (("ablations", "preset=quik"), "preset=quik: expected one of long, paper, quick, smoke"),
    (("ablations", "network.hidden=65536"), "network.blocks=4, network.hidden=65536: takes "),
    (("ui", "port=0"), f"port=0: {WHOLE} of at least 1 and at most 65535"),
    (("ui", "port=70000"), f"port=70000: {WHOLE} of at least 1 and at most 65535"),
    (("ui", "port=abc"), f"port=abc: {WHOLE} of at least 1 and at most 65535"),
    (("ui", f"port={'5' * 5000}"), f"...: {WHOLE} of at least 1 and at most 65535"),
    (("ui", "prot=5000"), "prot: no such option, expected port; did you mean port?"),
    (("ui", "5000"), "5000: expected key=value"),
    (("trian",), "invalid choice: 'trian'"),
    ((), "the following arguments are required: COMMAND; try: conflow --help"),
    (("train", "--seed=3"), "unrecognized arguments: --seed=3; try: conflow --help"),
]


@pytest.mark.parametrize(("arguments", "said"), OPTIONS, ids=range(len(OPTIONS)))
def test_a_bad_command(
    arguments: tuple[str, ...], said: str, command: Run, trained: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(trained)
    before = listing(trained)
    assert_refused(command(*arguments), said)
    assert listing(trained) == before


def test_a_port_in_use(command: Run, trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(trained)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert_refused(command("ui", f"port={port}"), f"port={port}: Address already in use, expected a free port")


def version(of: str) -> Callable[[Path, Path], None]:
    """A store whose schema has this version."""

    def change(runs: Path, good: Path) -> None:
        shutil.copy(good, runs / "mlflow.db")
        with closing(sqlite3.connect(runs / "mlflow.db")) as database, database:
            database.execute("UPDATE alembic_version SET version_num = ?", (of,))

    return change


def no_folder(runs: Path, _: Path) -> None:
    shutil.rmtree(runs)
    runs.write_text("x")


# What is done to a folder runs/ with a lock file, and what is said of it.
STORES: dict[str, tuple[Callable[[Path, Path], Any], str]] = {
    "runs is a file": (no_folder, "runs: File exists, expected a file or folder that can be used"),
    "garbage": (lambda runs, _: (runs / "mlflow.db").write_bytes(b"garbage" * 999), "file is not a database"),
    "truncated": (
        lambda runs, good: (runs / "mlflow.db").write_bytes(good.read_bytes()[:50_000]),
        "database disk image is malformed",
    ),
    "a folder": (
        lambda runs, _: (runs / "mlflow.db").mkdir(),
        "runs/mlflow.db: unable to open database file, expected",
    ),
    "older": (version("0a8213491aaa"), "out-of-date database schema (found version 0a8213491aaa"),
    "newer": (version("ffffffffffff"), "out-of-date database schema (found version ffffffffffff"),
}
OF_STORE = [
    ("train", "preset=smoke"),
    ("ablations", "preset=smoke", "ablations=cgp", "seeds=0"),
    ("evaluate",),
    ("compare",),
    ("reference",),
    ("sample", *PAIR),
    ("figures",),
    ("ui", "port=54321"),
]
BROKEN = [
    (what, arguments) for what in STORES for arguments in OF_STORE if what == "garbage" or arguments[0] == "compare"
]


@pytest.mark.parametrize(("what", "arguments"), BROKEN, ids=lambda value: value if isinstance(value, str) else value[0])
def test_a_broken_store(
    what: str,
    arguments: tuple[str, ...],
    command: Run,
    trained: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    spoil, said = STORES[what]
    runs = tmp_path / "runs"
    shutil.copytree(trained / "runs", runs, ignore=shutil.ignore_patterns("artifacts", "mlflow.db"))
    spoil(runs, trained / "runs" / "mlflow.db")
    before = listing(tmp_path)
    assert_refused(command(*arguments), said, "expected", "run")
    assert listing(tmp_path) == before


URIS = {
    "foo://bar": "MLFLOW_TRACKING_URI=foo://bar: ",
    "http://127.0.0.1:9": "MLFLOW_TRACKING_URI=http://127.0.0.1:9: Connection refused, expected a server of MLflow",
    "http://me:secret@127.0.0.1:9": "MLFLOW_TRACKING_URI=http://127.0.0.1:9: ",
    "http://127.0.0.1:99999": "Port out of range",
    "http://nowhere.invalid": "MLFLOW_TRACKING_URI=http://nowhere.invalid: ",
    "sqlite:////proc/x/y.db": "No such file or directory: '/proc/x'",
    "sqlite:////dev/full": "database or disk is full",
    "mysql://me:secret@127.0.0.1:9/x": "MLFLOW_TRACKING_URI=mysql://127.0.0.1:9/x: No module named 'MySQLdb'",
    "file:///proc/x": "MLFLOW_TRACKING_URI=file:///proc/x: ",
    "uc:x": "MLFLOW_TRACKING_URI=uc:x: ",
}


@pytest.mark.parametrize("uri", URIS)
def test_a_store_that_is_out_of_reach(
    uri: str, command: Run, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained / "runs", "runs", ignore=shutil.ignore_patterns("artifacts", "mlflow.db"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", uri)
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_TIMEOUT", "2")
    before = listing(tmp_path)
    outcome = command("compare")
    assert_refused(outcome, URIS[uri], "expected a")
    assert "secret" not in outcome.err
    assert listing(tmp_path) == before


@pytest.mark.parametrize(
    ("arguments", "output", "said"),
    [
        (("demonstrations", "num=10"), "/dev/full", "output: No space left on device, expected a file or folder"),
        (("train", b"seed=\xff"), "/dev/null", r"seed=\udcff: expected a whole number"),
    ],
)
def test_in_a_process_of_its_own(arguments: tuple[str | bytes, ...], output: str, said: str, tmp_path: Path) -> None:
    """An output that is full, of which Python would speak once more at its end, and bytes that are no text."""
    with Path(output).open("w") as out:
        finished = subprocess.run(
            [sys.executable, "-m", "conflow", *arguments], cwd=tmp_path, stdout=out, stderr=subprocess.PIPE, check=False
        )
    assert finished.returncode == 2
    assert finished.stderr.decode().startswith(f"conflow: {said}")
    assert finished.stderr.count(b"\n") == 1
    assert all(path.stat().st_size > 1000 for path in tmp_path.iterdir())  # the demonstrations are there, whole


@pytest.fixture(scope="module")
def planner() -> Planner:
    torch.manual_seed(0)
    return Planner(model_of(config.load(["preset=smoke"]), 32, 4))


GOOD: dict[str, Any] = {"start": (-0.8, 0.0, 0.8, 0.0), "goal": (0.8, 0.0, -0.8, 0.0), "num": 2}
REQUESTS: list[tuple[dict[str, Any], str]] = [
    ({"num": 10**9}, "num=1000000000: takes"),
    ({"num": 10**400}, "...: takes"),
    ({"num": 10**5000}, "num=a huge number: takes a huge number GiB"),
    ({"num": -(10**400)}, "...: expected a whole number of at least 1"),
    ({"num": "2"}, "num=2: expected a whole number of at least 1"),
    ({"num": None}, "num=None: expected a whole number"),
    ({"seed": float("nan")}, "seed=nan: expected a whole number of at least 0"),
    ({"seed": -1}, "seed=-1: expected a whole number of at least 0"),
    ({"start": "here"}, "start=here: expected numbers of shape (4,) or (B, 4)"),
    ({"start": {}}, "start={}: expected numbers"),
    ({"start": "☃\n" * 999}, "...: expected numbers"),
    ({"start": (10**400, 0, 0, 0)}, "...: expected numbers"),
    ({"start": (1e300, 0, 0, 0)}, "start=(1e+300, 0, 0, 0): expected finite numbers in the workspace"),
    ({"start": np.zeros((2, 2, 4))}, "found shape (2, 2, 4), expected"),
    ({"goal": torch.zeros(4, dtype=torch.cfloat)}, "found torch.complex64, expected"),
    ({"goal": torch.full((4,), torch.nan)}, "goal=(nan, nan, nan, nan): expected finite numbers"),
    ({"goal": [(0.8, 0.0, -0.8, 0.0)]}, "goal: found shape (1, 4), expected that of start, (4,)"),
    ({"obstacles": 3}, "obstacles=3: expected a sequence"),
    ({"obstacles": "abc"}, "obstacles[0]=a: expected an Obstacle or (x, y, radius)"),
    ({"obstacles": [None]}, "obstacles[0]=None: expected an Obstacle"),
    ({"obstacles": [Obstacle(0, 10**400, 1)]}, "obstacles[0]="),
    ({"obstacles": [(0, 0, float("inf"))]}, "obstacles[0]=(0, 0, inf): expected finite numbers and a radius above 0"),
    ({"via": [(0.5, (0, 0.5, 0, -0.5), 1)]}, "expected (s, position)"),
    ({"via": [(10**400, (0, 0.5, 0, -0.5))]}, "via[0]: s=1000"),
    ({"via": [(True, (0, 0.5, 0, -0.5))]}, "via[0]: s=True, expected a number above 0 and below 1"),
    ({"via": [(0.5, (0, 0.5, 0))]}, "via[0]=(0, 0.5, 0): found shape (3,), expected numbers of shape (4,)"),
    ({"guidance": ["robot"]}, "guidance=['robot']: expected one of none, all, robot, obstacle"),
    ({"guidance": "ROBOT"}, "guidance=ROBOT: expected one of none, all, robot, obstacle"),
    ({"robot_weight": float("nan")}, "robot_weight=nan: expected a finite number of at least 0"),
    ({"robot_weight": "1"}, "robot_weight=1: expected a finite number"),
    ({"obstacle_weight": 10**400}, "...: expected a finite number of at least 0 and at most 1000000000"),
]


@pytest.mark.parametrize(("changed", "said"), REQUESTS, ids=range(len(REQUESTS)))
def test_a_bad_request(changed: dict[str, Any], said: str, planner: Planner) -> None:
    with pytest.raises(PlanError) as refused:
        planner.plan(**GOOD | changed)
    assert said in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1
    assert len(str(refused.value)) < 300


@pytest.mark.parametrize("run", [3, None, b"cgp-s0", ["cgp-s0"], "☃", "", Path("none.ckpt"), "x\ny.ckpt", "\0.ckpt"])
def test_a_bad_name_of_a_run(run: Any, trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(trained)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    with pytest.raises(PlanError, match=r"^run=.*: .*expected") as refused:
        Planner.load(run)
    assert len(str(refused.value).splitlines()) == 1


def test_a_run_whose_model_is_gone(
    command: Run, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one line from every command that asks for it."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(trained / "runs", "runs")
    for model in Path("runs").rglob(MODEL_FILE):
        model.unlink()
    for arguments in (("evaluate",), ("figures",), ("sample", *PAIR)):
        outcome = command(*arguments, f"run={RUN}")
        assert_refused(outcome, MODEL_FILE, "expected")


@pytest.mark.parametrize("tree", [{}, {"seed": 3}, {"nothing": 3}, {"data": 3}, {"data": {"num": {"a": 1}}}])
def test_a_bad_tree(tree: Any) -> None:
    with pytest.raises(ConfigError, match=r"expected"):
        config.from_tree(tree)
