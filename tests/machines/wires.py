"""What lies between the machines of the lab, for tests to change. See tests/lab/machines.py."""

import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.lab.pace import bound
from tests.system.cells import run, wait_for

HERE = "a"
OTHERS = ("b", "c")


def ask(*words: str) -> None:
    """Change a cable or the power of a machine; the test fails if the lab cannot."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as lab:
        lab.settimeout(bound(60))
        lab.connect("/lab/control")
        lab.sendall(f"{' '.join(words)}\n".encode())
        with lab.makefile() as lines:
            answer = lines.readline()
    assert answer == "ok\n", f"{' '.join(words)}: {answer}"


def there(name: str, *command: str, user: str = "root") -> subprocess.CompletedProcess[str]:
    """Run a command in a shell on a machine, whatever its result. 255: ssh could not."""
    if (name, user) == (HERE, "root"):
        return run("bash", "-c", " ".join(command), check=False)
    return run(*_ssh(user, name), *command, check=False)


def bring(name: str, place: Path) -> None:
    """Put a directory in its place on another machine, instead of what is there."""
    pack = ["tar", "--create", f"--directory={place.parent}", place.name]
    files = subprocess.run(pack, stdout=subprocess.PIPE, check=True).stdout
    unpack = f"rm -rf {place} && tar --extract --directory={place.parent}"
    subprocess.run([*_ssh("root", name), unpack], input=files, check=True)


def _ssh(user: str, name: str) -> tuple[str, ...]:
    return ("ssh", "-oBatchMode=yes", "-oConnectTimeout=2", f"{user}@{name}")


def wait_up(name: str) -> None:
    wait_for(f"{name} is up", lambda: there(name, "true").returncode == 0)


@contextmanager
def cable(name: str, how: str) -> Iterator[None]:
    """Nothing goes through the cable of a machine meanwhile. how: "off" or "mute"."""
    ask("cable", name, how)
    try:
        yield
    finally:
        ask("cable", name, "on")
        wait_up(name)


@contextmanager
def power_cut(name: str) -> Iterator[None]:
    """The machine is off meanwhile."""
    ask("power", name, "off")
    try:
        yield
    finally:
        ask("power", name, "on")
        wait_up(name)


def clear(name: str) -> None:
    """Leave no dataflow on a machine."""
    with suppress(AssertionError):
        there(name, "doractl", "destroy", "--force")
