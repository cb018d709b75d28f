"""Every ablation for every seed on the machines of a Ray cluster. Imported only where that is asked for."""

import contextlib
import logging
import os
import platform
import signal
import socket
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nobody asked to report to its makers

import ray
from ray.exceptions import AuthenticationError, RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
from rich.console import Console

import conflow
from conflow.errors import ConfigError
from conflow.grid import local
from conflow.grid.local import Job
from conflow.tracking import carried, code, liveness, recording, signals, store
from conflow.training import config, progress
from conflow.training.progress import ProgressDisplay

OUTPUT = Path("runs", "output")
"""What cells print, a file each."""


@dataclass(frozen=True)
class Place:
    """Where and how cells are trained.

    Attributes:
        folder: in which the grid was started.
        shared: whether all machines see it.
        variables: of the environment, which say where the store is.
        cpus: of each cell.
        gpus: of each cell.
    """

    folder: Path
    shared: bool
    variables: dict[str, str]
    cpus: int
    gpus: int

    def enter(self) -> None:
        """Make it the current folder; where it is not shared, one of this machine's own."""
        folder = self.folder if self.shared else Path(tempfile.gettempdir(), f"conflow-{os.getuid()}")
        folder.mkdir(parents=True, exist_ok=True)
        os.chdir(folder)
        os.environ.update(self.variables)


@dataclass(frozen=True)
class Node:
    """What a machine of the cluster says of itself.

    Attributes:
        host: its name.
        code: the digests of its files that decide numbers.
        versions: of this program, Python and libraries.
        reads: what it reads where the grid wrote something.
        unreachable: why it cannot use the store, if so.
    """

    host: str
    code: Mapping[str, str]
    versions: Mapping[str, str]
    reads: str
    unreachable: str


@dataclass(frozen=True)
class Ended:
    """How a cell ended: on which machine, what is wrong with it, and what it printed where nobody else sees that."""

    host: str
    failure: str = ""
    output: str = ""


def run(
    ablations: Sequence[str],
    seeds: Sequence[str],
    arguments: Sequence[str],
    address: str,
    cpus: int,
    gpus: int,
    console: Console,
    any_code: bool = False,
) -> int:
    """Train the cells that are not finished yet, as many at a time as there is room for; the number that failed.

    Args:
        ablations: by name.
        seeds: each for every ablation.
        arguments: further settings of all cells.
        address: of the cluster's head, host:port, or "auto".
        cpus: that each cell gets.
        gpus: that each cell gets.
        console: for progress.
        any_code: take runs of other code as well.

    Raises:
        ConfigError: any of the cells cannot be asked for, or the cluster cannot be used; then none is started.
    """
    cells = local.cells(ablations, seeds, arguments)
    _connect(address)
    try:
        place = _place(address, cpus, gpus)
        hosts = "shared runs/" if place.shared else "runs/ of their own"
        console.print(f"{len(cells)} cells on {len(_nodes())} nodes with {hosts}", highlight=False)
        store.client()
        _train_all(cells, place, console, any_code)
    finally:
        ray.shutdown()
    return local.failures(cells, console)


def _connect(address: str) -> None:
    """Join the cluster, and take signals as before: Ray has its own way with SIGTERM.

    Raises:
        ConfigError: there is none.
    """
    handler = signal.getsignal(signal.SIGTERM)
    try:
        _check_reachable(address)
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except AuthenticationError as error:
        reason = str(error).partition(". ")[0]
        raise ConfigError(
            f"cluster={address}: {reason}; expected that of the cluster, see ray get-auth-token"
        ) from None
    except (OSError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"cluster={address}: {error}; expected a Ray cluster of which this machine is a node, try: ray start "
            "--head; one that wants a token: export RAY_AUTH_MODE=token"
        ) from None
    finally:
        signal.signal(signal.SIGTERM, handler)


def _check_reachable(address: str) -> None:
    """Refuse at once what Ray would try again for minutes.

    Raises:
        OSError: nobody answers.
        ValueError: the address is none.
    """
    found = ray._private.services.get_ray_address_from_environment(address, None)
    if found in (None, "auto"):
        raise ConnectionError("found none")
    host, _, port = str(found).rpartition(":")
    if not host or not port.isdecimal():
        raise ValueError("expected auto or host:port")
    try:
        socket.create_connection((host, int(port)), timeout=10).close()
    except OSError as error:
        raise ConnectionError(f"{found}: {error.strerror or error}") from None


def _nodes() -> list[dict[str, Any]]:
    return [node for node in ray.nodes() if node["Alive"]]


def _place(address: str, cpus: int, gpus: int) -> Place:
    """Where cells are trained, if every node can.

    Raises:
        ConfigError: a cell needs more than any node has, nodes differ in code or libraries, or cannot use the store.
    """
    resources = [node["Resources"] for node in _nodes()]
    if not any(one.get("CPU", 0) >= cpus and one.get("GPU", 0) >= gpus for one in resources):
        most = max(one.get("CPU", 0) for one in resources), max(one.get("GPU", 0) for one in resources)
        raise ConfigError(f"cpus={cpus} gpus={gpus}: expected what a node has, at most {most[0]:g} and {most[1]:g}")
    variables = {key: value for key, value in os.environ.items() if key.startswith("MLFLOW_")}
    store.RUNS.mkdir(parents=True, exist_ok=True)
    proof = (store.RUNS / f".shared-{uuid.uuid4().hex}").absolute()
    proof.write_text(proof.name)
    try:
        nodes = _look_at_all(address, proof, variables)
    finally:
        proof.unlink()
    _check_alike(address, nodes)
    shared = all(node.reads == proof.name for node in nodes)
    _check_store(address, nodes, shared)
    return Place(Path.cwd(), shared, variables, cpus, gpus)


def _check_store(address: str, nodes: Sequence[Node], shared: bool) -> None:
    """Refuse several hosts, or folders of their own, without a server, and a server that one of them does not reach.

    Raises:
        ConfigError: which nodes.
    """
    hosts = sorted({node.host for node in nodes})
    if not store.store_uri().startswith("http") and (len(hosts) > 1 or not shared):
        raise ConfigError(
            f"MLFLOW_TRACKING_URI={os.environ.get('MLFLOW_TRACKING_URI', '')}: found nodes on {', '.join(hosts)}, "
            "expected the address of an MLflow server that all of them reach"
        )
    for node in nodes:
        if node.unreachable:
            raise ConfigError(f"cluster={address}: node {node.host}: {node.unreachable}")


def _look_at_all(address: str, proof: Path, variables: dict[str, str]) -> list[Node]:
    look = ray.remote(num_cpus=0, max_retries=0)(_look)
    asked = [
        (
            node["NodeManagerHostname"],
            look.options(scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)).remote(
                proof, variables
            ),
        )
        for node in _nodes()
    ]
    found = []
    for name, answer in asked:
        try:
            found.append(ray.get(answer, timeout=300))
        except RayError as error:
            said = [line.strip() for line in str(error).splitlines() if line.strip()][-1]
            raise ConfigError(
                f"cluster={address}: node {name}: {said}, expected one where conflow is installed"
            ) from None
    return found


def _look(proof: Path, variables: dict[str, str]) -> Node:
    """What is to be known of the machine that this is called on."""
    os.environ.update(variables)
    try:
        store.check_reachable()
        unreachable = ""
    except ConfigError as error:
        unreachable = str(error)
    reads = proof.read_text() if proof.exists() else ""
    return Node(platform.node(), dict(code.files()), recording.versions(), reads, unreachable)


def _check_alike(address: str, nodes: Sequence[Node]) -> None:
    """Refuse nodes whose numbers would be of other code or other libraries than this process's.

    Raises:
        ConfigError: which node, and in what it differs.
    """
    ours, files = recording.versions(), code.files()
    for node in nodes:
        other = [f"{name} {found}" for name, found in node.versions.items() if found != ours.get(name)]
        expected = [f"{name} {ours[name]}" for name, found in node.versions.items() if found != ours.get(name)]
        names = sorted(name for name in files.keys() | node.code.keys() if files.get(name) != node.code.get(name))
        if other or names:
            raise ConfigError(
                f"cluster={address}: node {node.host}: found other {', '.join(other + names)}, "
                f"expected the same as on {platform.node()}{': ' if expected else ''}{', '.join(expected)}"
            )


class Progress:
    """An actor to which the cells' tasks say how far they are."""

    def __init__(self) -> None:
        self.said: dict[int, tuple[str, float, float]] = {}

    def say(self, number: int, found: tuple[str, float, float]) -> None:
        """Of a cell: its stage, how much of it is done, and how much there is."""
        self.said[number] = found

    def all(self) -> dict[int, tuple[str, float, float]]:
        """What was said last of each."""
        return self.said


def _train_all(cells: Sequence[Job], place: Place, console: Console, any_code: bool) -> None:
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    board = ray.remote(num_cpus=0)(Progress).options(scheduling_strategy=here).remote()
    # A worker that is killed and a node that is gone are no failures of a cell.
    train = ray.remote(num_cpus=place.cpus, num_gpus=place.gpus, max_retries=3)(_attempt)
    waiting = {
        train.remote(number, cell.arguments, cell.config.sha(), any_code, place, board): cell
        for number, cell in enumerate(cells)
    }
    with ProgressDisplay(console) as display:
        task = display.add("cells", len(cells))
        try:
            while waiting:
                time.sleep(0.5)
                for done in ray.wait(list(waiting), num_returns=len(waiting), timeout=0)[0]:
                    _settle(waiting.pop(done), done, place)
                with contextlib.suppress(RayError):
                    for number, found in ray.get(board.all.remote(), timeout=10).items():
                        if cells[number] in waiting.values():
                            cells[number].look(found)
                display.update(task, *local.overview(cells))
        except BaseException:
            with signals.held():
                for one in waiting:
                    ray.cancel(one)
                ray.wait(list(waiting), num_returns=len(waiting), timeout=600)
            raise


def _settle(cell: Job, done: Any, place: Place) -> None:
    """Take from a task that is over how its cell ended."""
    try:
        ended: Ended = ray.get(done)
    except RayError as error:
        ended = Ended("", " ".join(str(error).split("\n\n")[0].split()))
    cell.failed = bool(ended.failure)
    cell.output = [ended.failure]
    cell.share, cell.note = 1.0, ""
    if ended.output and not place.shared:
        _append(cell, ended.output)


def _append(cell: Job, text: str) -> None:
    path = output_of(cell)
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(text)


def output_of(cell: Job) -> Path:
    """The file of what a cell prints, one attempt after the other."""
    return OUTPUT / cell.config.preset / f"{cell.name}.txt"


def _attempt(number: int, arguments: list[str], sha: str, any_code: bool, place: Place, board: Any) -> Ended:
    """Train a cell on this machine, unless it is finished; go on with it if an attempt before was interrupted.

    Ray calls this again when its process or its machine is gone, so that here is looked what there is.
    """
    host = platform.node()
    place.enter()
    os.environ[liveness.ENGINE_TASK] = ray.get_runtime_context().get_task_id()
    cell = Job(list(arguments), config.load(arguments))
    if cell.config.sha() != sha:
        return Ended(host, f"{host}: found other settings in conf/, expected the same as where the grid was started")
    while other := local.elsewhere(cell, any_code):
        board.say.remote(number, (f"waits for {other}", 0, 1))
        time.sleep(5)
    if local.finished(cell, any_code):
        return Ended(host)
    _append(cell, f"On {host}, {time.strftime('%Y-%m-%d %H:%M:%S')}\n")
    began = output_of(cell).stat().st_size
    with tempfile.TemporaryDirectory() as folder, output_of(cell).open("a") as output:
        said = Path(folder, "progress")
        child = subprocess.Popen(
            [sys.executable, "-m", "conflow", "train", *cell.arguments, *cell.resume],
            stdout=output,
            stderr=subprocess.STDOUT,
            env=_environment(place) | {progress.FILE: str(said)},
        )
        # It stays in the worker's process group, which Ray ends with the worker. Waiting must not block: Ray
        # interrupts Python alone.
        try:
            while child.poll() is None:
                time.sleep(0.5)
                if found := progress.read(said):
                    board.say.remote(number, found)
        finally:
            if child.poll() is None:
                child.terminate()
                while child.poll() is None:
                    time.sleep(0.1)
    with output_of(cell).open() as file:
        file.seek(began)
        text = file.read()
    lines = [line.strip() for line in text.splitlines() if line.strip()] or ["no output"]
    return Ended(host, f"on {host}: {lines[-1]}" if child.returncode else "", "" if place.shared else text)


def _environment(place: Place) -> dict[str, str]:
    """The variables of a cell's process."""
    paths = [str(Path(conflow.__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
    own = {"OMP_NUM_THREADS": str(place.cpus), "PYTHONPATH": os.pathsep.join(paths)}
    own |= {} if place.gpus else {"CUDA_VISIBLE_DEVICES": ""}  # of which Ray hides none from a task without
    return {**os.environ, **own} | ({} if place.shared else {carried.ASKED: "1"})
