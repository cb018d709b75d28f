"""Hosts that are network namespaces with names of their own, on a bridge whose links can be cut."""

import subprocess
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class Host:
    """One of them.

    Attributes:
        name: what `hostname` says there.
        address: its own on the bridge.
        namespace: the network's name.
        link: the bridge's end of its cable.
    """

    name: str
    address: str
    namespace: str
    link: str

    def command(self, *command: str) -> list[str]:
        """A command as it is run there."""
        named = ["unshare", "--uts", "sh", "-c", f'hostname {self.name}; exec "$@"', "sh"]
        return ["ip", "netns", "exec", self.namespace, *named, *command]

    def start(
        self, folder: Path, *command: str, environment: Mapping[str, str], output: str
    ) -> "subprocess.Popen[str]":
        """A process there, whose output goes to a file in the folder."""
        with (folder / output).open("w") as file:
            return subprocess.Popen(
                self.command(*command), cwd=folder, env=dict(environment), text=True, stdout=file, stderr=file
            )

    def cut(self) -> None:
        """From here on nothing reaches it or comes from it."""
        ip("link", "set", self.link, "down")

    def mend(self) -> None:
        ip("link", "set", self.link, "up")


@contextmanager
def connected(*names: str) -> Iterator[tuple[str, tuple[Host, ...]]]:
    """The address of this machine on a bridge, and hosts on it; skips where they cannot be made."""
    tag = uuid.uuid4().hex[:6]
    net = f"10.{200 + int(tag[:2], 16) % 50}.{int(tag[2:4], 16)}"
    bridge = f"cf{tag}b"
    hosts = tuple(Host(name, f"{net}.{i + 2}", f"cf{tag}{i}", f"cf{tag}l{i}") for i, name in enumerate(names))
    try:
        try:
            ip("link", "add", bridge, "type", "bridge")
            ip("address", "add", f"{net}.1/24", "dev", bridge)
            ip("link", "set", bridge, "up")
            for host in hosts:
                ip("netns", "add", host.namespace)
                ip("link", "add", host.link, "type", "veth", "peer", "name", "eth0", "netns", host.namespace)
                ip("link", "set", host.link, "master", bridge, "up")
                ip("-n", host.namespace, "address", "add", f"{host.address}/24", "dev", "eth0")
                for device in ("lo", "eth0"):
                    ip("-n", host.namespace, "link", "set", device, "up")
                subprocess.run(host.command("true"), check=True, capture_output=True, text=True)
        except (OSError, subprocess.CalledProcessError) as error:
            pytest.skip(f"no network namespaces can be made here: {getattr(error, 'stderr', None) or error}")
        yield f"{net}.1", hosts
    finally:
        for command in (*(["netns", "delete", host.namespace] for host in hosts), ["link", "delete", bridge]):
            subprocess.run(["ip", *command], capture_output=True)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)
