"""The lines for SLURM in `conflow/tracking/ranks.py`, as SLURM itself runs them on two hosts."""

import itertools
import os
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

import conflow
from conflow.tracking import ranks
from tests.faults import processes
from tests.faults.hosts import Host, connected
from tests.faults.processes import history, runs, wait_for_metrics
from tests.faults.test_concurrency import stopped_afterwards
from tests.faults.test_devices import TRAIN, assert_equal_up_to_rounding

# Where Debian keeps the daemons, and what the PATH finds; the jobs' `python` is this one.
PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", ""), "/usr/sbin"])
PROGRAMS = ("munged", "slurmctld", "slurmd", "sinfo", "sbatch", "srun", "scontrol", "scancel")
MISSING = [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]
pytestmark = pytest.mark.skipif(bool(MISSING), reason=f"no SLURM to test with, missing: {', '.join(MISSING)}")

# A device that needs no driver stands for the GPU.
CONFIGURATION = """
ClusterName=test
SlurmctldHost={first.name}({first.address})
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={folder}/munge
SlurmUser=root
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
GresTypes=gpu
{nodes}
PartitionName=all Nodes=ALL Default=YES
"""
NODE = "NodeName={0.name} NodeAddr={0.address} CPUs=1 Gres=gpu:1"
# The plugin is loaded also where nothing uses it; this one begins without a file system of its own.
CGROUPS = "CgroupPlugin=cgroup/v1\nCgroupAutomount=no\n"
HAS = ("--gpus-per-node=1", "--cpus-per-task=1")
"""What there is on a test machine of what the lines ask for."""
AT_WORK = {"PENDING", "CONFIGURING", "RUNNING", "COMPLETING"}


@dataclass(frozen=True)
class Slurm:
    """A cluster.

    Attributes:
        host: where commands are given.
        environment: with which they find it.
    """

    host: Host
    environment: dict[str, str]

    def says(self, *command: str, folder: Path = Path()) -> str:
        """What a command of SLURM prints."""
        said = subprocess.run(
            self.host.command(*command), cwd=folder, env=self.environment, text=True, capture_output=True, timeout=120
        )
        assert said.returncode == 0, said.stderr
        return said.stdout.strip()

    def submit(self, folder: Path, *arguments: str) -> str:
        """The number of a job that runs the documented lines in a folder; it prints to the file `output` there."""
        (folder / "train.sh").write_text(documented())
        return self.says("sbatch", "--parsable", *HAS, "--output=output", "train.sh", *arguments, folder=folder)

    def state(self, job: str) -> str:
        """That of a job and its exit code, such as COMPLETED 0:0."""
        said = self.says("scontrol", "--oneliner", "show", "job", job)
        found = dict(entry.partition("=")[::2] for entry in said.split())
        return f"{found['JobState']} {found['ExitCode']}"

    def ended(self, job: str) -> str:
        """The state of a job in which it ends."""
        return wait(lambda: self.state(job), lambda state: state.split()[0] not in AT_WORK, 300)


def documented() -> str:
    """The lines, from the first one of the script to an empty one."""
    lines = itertools.dropwhile(lambda line: line != "    #!/bin/bash", str(ranks.__doc__).splitlines())
    return textwrap.dedent("\n".join(itertools.takewhile(bool, lines))) + "\n"


def wait(look: Callable[[], str], enough: Callable[[str], bool], seconds: float) -> str:
    """What is seen as soon as it is enough.

    Raises:
        TimeoutError: says what was seen instead.
    """
    deadline = time.monotonic() + seconds
    while not enough(seen := look()):
        if time.monotonic() > deadline:
            raise TimeoutError(seen)
        time.sleep(0.3)
    return seen


@pytest.fixture(scope="module")
def slurm() -> Iterator[Slurm]:
    """A cluster of two hosts with one folder, on the first of which is the controller."""
    with (
        tempfile.TemporaryDirectory(prefix="slurm") as name,  # whose socket's path must be short
        connected("alpha", "beta") as (_, hosts),
        ExitStack() as stack,
    ):
        folder = Path(name)
        configure(folder, hosts)
        started = Slurm(hosts[0], environment(folder))
        for host, command in daemons(folder, hosts):
            output = f"{command[0]}.{host.name}"
            process = host.start(folder, *command, environment=started.environment, output=output)
            stack.enter_context(stopped_afterwards(process))
        try:
            wait(lambda: nodes(started), lambda states: states.split() == ["idle"] * len(hosts), 60)
        except TimeoutError as error:
            said = [path.read_text().splitlines()[-1:] for path in sorted(folder.glob("*.alpha"))]
            pytest.skip(f"no SLURM can be started here: nodes {error}; {said}")
        yield started


def daemons(folder: Path, hosts: tuple[Host, ...]) -> list[tuple[Host, list[str]]]:
    """Where each is started, and how. Two hosts of one machine share that which proves who somebody is."""
    munged = ["munged", "--foreground", "--force", f"--socket={folder / 'munge'}"]
    munged += [f"--{kind}-file={folder / f'munge.{kind}'}" for kind in ("key", "pid", "seed", "log")]
    on_first = [(hosts[0], munged), (hosts[0], ["slurmctld", "-D"])]
    return on_first + [(host, ["slurmd", "-D"]) for host in hosts]


def nodes(slurm: Slurm) -> str:
    """The state of each; what is wrong while there is no controller."""
    try:
        return slurm.says("sinfo", "--noheader", "--Node", "--format=%t")
    except (AssertionError, subprocess.TimeoutExpired) as error:
        return str(error)


def configure(folder: Path, hosts: tuple[Host, ...]) -> None:
    (folder / "state").mkdir()
    (folder / "munge.key").touch(0o600)
    (folder / "munge.key").write_bytes(os.urandom(128))
    known = "\n".join(NODE.format(host) for host in hosts)
    (folder / "slurm.conf").write_text(CONFIGURATION.format(first=hosts[0], folder=folder, nodes=known))
    (folder / "gres.conf").write_text("Name=gpu File=/dev/null\n")
    (folder / "cgroup.conf").write_text(CGROUPS)


def environment(folder: Path) -> dict[str, str]:
    """That of all daemons and commands, which SLURM hands on to jobs; of a job that runs the tests nothing."""
    others = ("SLURM", "SBATCH", "SRUN", "MLFLOW_TRACKING_URI")
    kept = {key: value for key, value in os.environ.items() if not key.startswith(others)}
    own = {"SLURM_CONF": str(folder / "slurm.conf"), "PYTHONPATH": str(Path(conflow.__file__).parents[1])}
    return kept | own | {"PATH": PATH, "OMP_NUM_THREADS": "1"}


def test_a_job_on_two_nodes_trains_what_one_process_does(slurm: Slurm, tmp_path: Path) -> None:
    job = slurm.submit(tmp_path, *TRAIN[1:])
    assert slurm.ended(job) == "COMPLETED 0:0", (tmp_path / "output").read_text()
    (together,) = runs(tmp_path)
    assert together.info.status == "FINISHED"
    assert (together.data.tags["devices"], together.data.tags["host"]) == ("2", "alpha")
    code, output = processes.run(tmp_path, *TRAIN)
    assert code == 0, output
    alone, _ = runs(tmp_path)
    assert_equal_up_to_rounding(tmp_path, alone, together)


def test_what_a_cancelled_job_leaves_the_next_one_ends(slurm: Slurm, tmp_path: Path) -> None:
    long = (*TRAIN[1:], "train.max_steps=3000", "train.val_every=1500", "train.log_every=50")
    job = slurm.submit(tmp_path, *long)
    wait_for_metrics(tmp_path, "cgp-s0")
    slurm.says("scancel", job)
    assert slurm.ended(job).startswith("CANCELLED"), (tmp_path / "output").read_text()
    assert "conflow: interrupted by SIGTERM" in (tmp_path / "output").read_text()
    (cancelled,) = runs(tmp_path)
    assert cancelled.info.status == "KILLED"
    job = slurm.submit(tmp_path, *long, "resume=latest")
    assert slurm.ended(job) == "COMPLETED 0:0", (tmp_path / "output").read_text()
    (resumed,) = runs(tmp_path)
    assert resumed.info.run_id == cancelled.info.run_id
    assert (resumed.info.status, resumed.data.tags["resumed"]) == ("FINISHED", "1")
    steps = [step for step, _ in history(tmp_path, resumed)["train/loss"]]
    assert steps == sorted(set(steps)), "no step is written twice"
