"""The dataflow of flows.py with `link: direct`."""

from dataclasses import dataclass
from pathlib import Path

from tests.lab.pace import bound
from tests.machines.flows import PLACE, Flow
from tests.system.cells import Project

ADDRESSES = {"a": "10.77.0.1", "b": "10.77.0.2", "c": "10.77.0.3"}


@dataclass(frozen=True)
class DirectFlow(Flow):
    """Its machines are in a settings file on the head."""

    def bring(self) -> None:
        """The same files on all machines, and the settings."""
        super().bring()
        self.write_settings()

    def write_settings(self, **changed: str) -> None:
        """Other keys of `gpu` in the settings."""
        lines = ["machines:"]
        for name, machine in self.members.items():
            entry = {"host": machine, "link": "direct", "address": ADDRESSES[machine]}
            entry |= changed if name == "gpu" else {}
            told = ", ".join(f'{key}: "{text}"' for key, text in entry.items())
            lines.append(f"  {name}: {{{told}}}")
        place = Project(Path(PLACE), is_new=False)
        place.write("dataflow.systemd.yml", "\n".join([*lines, ""]))

    def flags(self) -> list[str]:
        """The settings say where the machines are; a slow machine gets more time."""
        return [f"--start-timeout={bound(30):.0f}s"]
