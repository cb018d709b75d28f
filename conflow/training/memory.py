"""What does not fit into this machine's memory is refused before it is tried."""

import os
from pathlib import Path

from conflow.errors import ConfigError, brief
from conflow.tracking import ranks
from conflow.training.config import Config


def memory() -> int:
    """The bytes of memory that this machine has, or that its control group leaves to this process."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        return min(machine, int(Path("/sys/fs/cgroup/memory.max").read_text()))
    except (OSError, ValueError):  # there is no such group, or it says max
        return machine


def check_memory(key: str, value: int, needed: int) -> None:
    """Refuse a setting before it takes memory that this machine does not have.

    Args:
        key: the setting.
        value: what it is set to.
        needed: bytes that it surely takes.

    Raises:
        ConfigError: it would take more than the machine has.
    """
    if needed > memory():
        raise ConfigError(
            f"{key}={brief(value)}: takes {brief(-(-needed // 2**30))} GiB of memory or more, "
            f"expected what fits into the {memory() // 2**30} GiB that this machine has"
        )


def check_training(config: Config) -> None:
    """Refuse an accelerator that is missing, and a network and a batch that do not fit into this machine's memory.

    Where demonstrations are read from a file, T and D are not known yet, and the smallest are assumed.

    Raises:
        ConfigError: names the setting, what it asks for and what the machine has.
    """
    import torch  # only now: a mistyped setting is answered before

    cuda, mps = torch.cuda.is_available(), torch.backends.mps.is_available()
    has = {"auto": True, "cpu": True, "gpu": cuda or mps, "mps": mps}
    if not has[config.train.accelerator]:
        known = ", ".join(name for name, there in has.items() if there)
        raise ConfigError(f"train.accelerator={config.train.accelerator}: not on this machine, expected one of {known}")
    if ranks.world() > 1 and config.train.accelerator != "cpu":
        there = torch.cuda.device_count() if cuda else 0
        if (cuda and there < ranks.on_node()) or (mps and not cuda):
            found = f"{ranks.on_node()} processes on a machine that has {there} GPUs for them"
            raise ConfigError(f"train.accelerator={config.train.accelerator}: found {found}, expected cpu")
    network, batch = config.network, config.train.batch_size
    size = 4 * config.data.horizon if config.data.path is None else 12
    weights = 2 * network.blocks * network.hidden**2
    if network.kind == "resmlp":
        weights += 2 * size * network.hidden
    # In single precision, each weight with its gradient and Adam's two moments.
    check_memory(f"network.blocks={network.blocks}, network.hidden", network.hidden, 16 * weights)
    # x_0, x_1, x_t, u_t and v; and what the backward pass needs of each block.
    floats = 5 * size + 4 * network.blocks * network.hidden
    if config.train.accelerator == "cpu" or not cuda:  # whose memory is another
        check_memory("train.batch_size", batch, 4 * batch * floats)
