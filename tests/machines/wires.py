"""What lies between the machines of the lab, for tests to change. See tests/lab/machines.py."""

import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from tests.lab.pace import bound
from tests.system.cells import run, wait_for

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
    """Run a command on a machine, whatever its result. 255: ssh could not."""
    options = ("-oBatchMode=yes", "-oConnectTimeout=2")
    return run("ssh", *options, f"{user}@{name}", *command, check=False)


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
