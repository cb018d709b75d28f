"""The processes that train one run together, each on a device of its own, as torchrun starts them.

`make train DEVICES=2` is `python -m torch.distributed.run --standalone --nproc-per-node=2 -m conflow train ...`. How
many there are is no part of what an experiment is: each draws the whole batch from (seed, step) and takes its share,
so the gradient is that of one process up to rounding. Rank 0 alone touches the store, prints and evaluates.

On several nodes the same command runs once on each, with torchrun's own options. For SLURM, as `train.sh`:

    #!/bin/bash
    #SBATCH --nodes=2 --ntasks-per-node=1 --gpus-per-node=4 --cpus-per-task=32
    export MASTER=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)
    srun --cpus-per-task=$SLURM_CPUS_PER_TASK bash -c 'python -m torch.distributed.run --nnodes=$SLURM_NNODES \
        --node-rank=$SLURM_NODEID --master-addr=$MASTER --master-port=29500 --nproc-per-node=$SLURM_GPUS_ON_NODE \
        -m conflow train "$@"' conflow "$@"

Then `sbatch train.sh ablation=plus preset=paper` trains, and with `resume=latest` as well goes on with what a cancelled
job has left. The node of rank 0 is always the job's first, where `runs/` is. What reads no file of its own, such as the
demonstrations of `data.path`, needs no folder that the nodes share: a run goes on from the checkpoint that rank 0
reads.

Imports torch only where there are several, since the command line asks for the rank before anything else.
"""

import os
import platform
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from conflow.errors import ConfigError

if TYPE_CHECKING:
    from torch import Tensor

T = TypeVar("T")

if "TORCHELASTIC_RUN_ID" in os.environ:
    # DistributedDataParallel warns of every choice that is not its own; read as torch is imported.
    os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")


def _of_environment(name: str, alone: int) -> int:
    """A number that torchrun tells; what it is for a process that torchrun did not start."""
    return int(os.environ[name]) if "TORCHELASTIC_RUN_ID" in os.environ else alone


def rank() -> int:
    """Which of the processes this is; 0 where there is one."""
    return _of_environment("RANK", 0)


def world() -> int:
    """How many processes there are."""
    return _of_environment("WORLD_SIZE", 1)


def on_node() -> int:
    """How many of them are on this machine."""
    return _of_environment("LOCAL_WORLD_SIZE", 1)


def share(count: int) -> slice:
    """The rows of a batch that are this process's: as many as everybody's, so that the mean of means is the mean.

    >>> share(1024)
    slice(0, 1024, None)
    """
    own = count // world()
    return slice(rank() * own, (rank() + 1) * own)


@contextmanager
def joined(together: type[Exception]) -> Iterator[None]:
    """The processes can reach each other within the block, or until they `leave` it.

    Args:
        together: an error that all of them meet at once. Where one process has ended torchrun ends the others, so they
            wait until each has dealt with it.
    """
    if world() > 1:
        import torch

        gpu = torch.cuda.is_available()
        if gpu:
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]) % torch.cuda.device_count())
        torch.distributed.init_process_group("cpu:gloo,cuda:nccl" if gpu else "gloo")
    try:
        yield
    except together:
        wait()
        raise
    finally:
        leave()


def leave() -> None:
    """From here on this process is on its own."""
    if _together():
        import torch

        torch.distributed.destroy_process_group()


def _together() -> bool:
    """Whether there is another process that can be reached."""
    if world() == 1:
        return False
    import torch

    return torch.distributed.is_initialized()


def of_first(make: Callable[[], T]) -> T:
    """What `make` returns in rank 0, which alone calls it."""
    made = [make() if rank() == 0 else None]
    if _together():
        import torch

        torch.distributed.broadcast_object_list(made, 0)
    return made[0]  # type: ignore[return-value]


def first_says(condition: bool) -> bool:
    """Whether a condition holds in rank 0, at less cost than `of_first`: that of one byte."""
    if not _together():
        return condition
    import torch

    said = torch.tensor([condition])
    torch.distributed.broadcast(said, 0)
    return bool(said)


def each(value: T) -> list[T]:
    """The value of every process, by rank."""
    if not _together():
        return [value]
    import torch

    values: list[Any] = [None] * world()
    torch.distributed.all_gather_object(values, value)
    return values


def mean(x: "Tensor") -> "Tensor":
    """The mean of a tensor over the processes."""
    if not _together():
        return x
    import torch

    summed = x.clone()
    torch.distributed.all_reduce(summed)
    return summed / world()


def lost(error: BaseException) -> bool:
    """Whether this is what a process meets when another one has gone."""
    return world() > 1 and isinstance(error, RuntimeError) and bool(re.search("gloo|NCCL|TCPStore", str(error)))


def wait() -> None:
    """Until every process has come here."""
    each(None)


@contextmanager
def all_or_none() -> Iterator[None]:
    """What fails within the block in one of the processes fails in all, so that rank 0 can say it.

    Raises:
        ConfigError: in a process that did not fail itself: what the first one that did says.
    """
    error: Exception | None = None
    try:
        yield
    except Exception as caught:
        error = caught
    errors = each(f"rank {rank()} on {platform.node()}: {error}" if error else "")
    if error:
        raise error
    for said in filter(None, errors):
        raise ConfigError(said)


def check_alike(*known: Mapping[str, str]) -> None:
    """Refuse processes that would not train the same, such as nodes with other code.

    Args:
        known: what must be the same everywhere, by name.

    Raises:
        ConfigError: names what differs, between which ranks.
    """
    own = {name: value for one in known for name, value in one.items()}
    (first, expected), *others = each((platform.node(), own))
    for number, (host, found) in enumerate(others, start=1):
        for name in expected | found:
            if (one := found.get(name)) != (other := expected.get(name)):
                raise ConfigError(
                    f"{name}: found {one} on rank {number}, {host}, expected {other} as on rank 0, {first}"
                )
