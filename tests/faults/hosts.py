"""Hosts that are network namespaces, know each other by name, and are on a bridge whose links can be cut."""

import contextlib
import os
import signal
import subprocess
import tempfile
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
        known: the file of the names and addresses of all.
    """

    name: str
    address: str
    namespace: str
    link: str
    known: Path

    def command(self, *command: str) -> list[str]:
        """A command as it is run there."""
        # Its own view of the files that are mounted is what `ip netns exec` gives it.
        named = f'hostname {self.name} && mount --bind {self.known} /etc/hosts && exec "$@"'
        return ["ip", "netns", "exec", self.namespace, "unshare", "--uts", "sh", "-c", named, "sh", *command]

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

    def stop(self) -> None:
        """Kill every process there, also those of no parent."""
        found = subprocess.run(["ip", "netns", "pids", self.namespace], capture_output=True, text=True)
        for pid in found.stdout.split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(pid), signal.SIGKILL)


@contextmanager
def connected(*names: str) -> Iterator[tuple[str, tuple[Host, ...]]]:
    """The address of this machine on a bridge, and hosts on it; skips where they cannot be made."""
    tag = uuid.uuid4().hex[:6]
    net = f"10.{200 + int(tag[:2], 16) % 50}.{int(tag[2:4], 16)}"
    bridge = f"cf{tag}b"
    folder = tempfile.TemporaryDirectory(prefix="hosts")
    known = Path(folder.name, "hosts")
    hosts = tuple(Host(name, f"{net}.{i + 2}", f"cf{tag}{i}", f"cf{tag}l{i}", known) for i, name in enumerate(names))
    known.write_text("127.0.0.1 localhost\n" + "".join(f"{host.address} {host.name}\n" for host in hosts))
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
        for host in hosts:
            host.stop()
        for command in (*(["netns", "delete", host.namespace] for host in hosts), ["link", "delete", bridge]):
            subprocess.run(["ip", *command], capture_output=True)
        folder.cleanup()


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)
