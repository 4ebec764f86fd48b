"""A network namespace of the run's own with a bridge in it, and cables to the machines."""

import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from lab.errors import LabError

BRIDGE = "switch"
PREFIX = "10.77.0."


def address(number: int) -> str:
    """Of machine `number`, from 0 on."""
    return f"{PREFIX}{number + 1}"


class Network:
    """place: a file that stands for the namespace. It ends with the lab's own mounts."""

    def __init__(self, place: Path) -> None:
        self.place = place
        place.touch()
        call(["unshare", f"--net={place}", "true"])
        self._ip("link", "add", BRIDGE, "type", "bridge")
        self._ip("link", "set", BRIDGE, "up")

    def enter_command(self) -> list[str]:
        """The words that start a command inside."""
        return ["nsenter", f"--net={self.place}", "--"]

    def plug(self, cable: str) -> None:
        """Connect the end of a cable with the bridge."""
        self._ip("link", "set", cable, "master", BRIDGE, "up")

    def unplug(self, cable: str) -> None:
        """Pull a cable: its machine sees that there is no carrier."""
        self._ip("link", "set", cable, "down")

    def mute(self, cable: str) -> None:
        """Lose every packet; nobody sees a link go down, as with a switch further on."""
        self._ip("link", "set", cable, "nomaster")

    def remove(self, cable: str) -> None:
        """Remove a cable. The kernel does it too, some time after the machine has gone."""
        with suppress(LabError):
            self._ip("link", "delete", cable)

    def _ip(self, *words: str) -> None:
        call([*self.enter_command(), "ip", *words])


def call(command: Sequence[str]) -> None:
    """Raises LabError with what the command says."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr or done.stdout).strip()
        raise LabError(f"{' '.join(command)}: {said}", "the lab's machines need network namespaces")
