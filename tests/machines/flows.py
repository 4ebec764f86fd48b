"""A dataflow over the machines of the lab: its head is on a, its members are b and perhaps c."""

import json
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from tests.machines.journals import quiet_journals
from tests.machines.wires import bring, there
from tests.system.cells import DOUBLER, SINK, SOURCE, Cell, Project, dora_processes, run, wait_for

PLACE = "/opt/flow"
NAME = "flow"
TWO = {"gpu": "b"}
THREE = {"gpu": "b", "arm": "c"}
"""The members of the dataflow: name in the settings, and host."""
GRACE = 2
_DATAFLOW = """
nodes:
  - id: source
    path: source.py
    inputs: {{tick: dora/timer/millis/50}}
    outputs: [number]
  - id: doubler
    path: doubler.py
    inputs: {{number: {{source: source/number, queue_size: 1000}}}}
    outputs: [double]
    deploy: {{machine: gpu}}
  - id: sink
    path: sink.py
    inputs: {{double: {{source: doubler/double, queue_size: 1000}}}}
    deploy: {{machine: {sink}}}
"""
_PROCESSES = "'pgrep -af \"dora_systemd|dora (daemon|coordinator)|/opt/flow\" | grep -v pgrep'"


@dataclass(frozen=True)
class Flow:
    """A dataflow on a and `members`, machine by name of the dataflow."""

    members: dict[str, str]

    @property
    def cell(self) -> Cell:
        """The unit of the head."""
        return Cell(NAME)

    @property
    def machines(self) -> Sequence[str]:
        """All of them."""
        return ("a", *self.members.values())

    def write(self) -> None:
        """The files on a."""
        place = Project(Path(PLACE), is_new=False)
        Path(PLACE, "dataflow.systemd.yml").unlink(missing_ok=True)  # of another test
        for name, text in (("source", SOURCE), ("doubler", DOUBLER), ("sink", SINK)):
            place.write(f"{name}.py", text)
        place.write("dataflow.yml", _DATAFLOW.format(sink="arm" if "arm" in self.members else "a"))

    def bring(self) -> None:
        """The same files on all machines."""
        self.write()
        for machine in self.members.values():
            bring(machine, Path(PLACE))

    def flags(self) -> list[str]:
        """For `doractl start`."""
        return [f"--machine={name}={host}" for name, host in self.members.items()]

    def start(self, *flags: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Start it, and wait for all of its nodes."""
        file = Path(PLACE) / "dataflow.yml"
        return self.cell.start(file, *self.flags(), *flags, check=check)

    def refused(self, *words: str, code: int, flags: Sequence[str] = ()) -> None:
        """Start it: one line with these words, and nothing is left anywhere."""
        done = self.start(*flags, check=False)
        assert done.returncode == code, done.stderr
        for word in words:
            assert word in done.stderr
        assert "Traceback" not in done.stderr
        assert not self.left()

    def status(self) -> str:
        """The status of the head's unit for people."""
        return self.cell.show("StatusText")

    def is_running(self) -> bool:
        """Whether all nodes are ready, as far as the head knows."""
        return self.cell.show("ActiveState") == "active"

    def life(self) -> str:
        """What is new with each run."""
        table = Path(f"/run/dora-systemd/{NAME}/status.json")
        run = json.loads(table.read_text())["run"] if table.exists() else ""
        return f"{self.cell.show('InvocationID')} {run}"

    def wait_again(self, life: str) -> None:
        """Return when another run than that of `life` is there, and messages flow."""
        wait_for("it runs again", lambda: self.life() != life and self.is_running(), 60)
        self.wait_exchanging()

    def wait_exchanging(self) -> None:
        """Return when the sink has got something new."""
        before = self.heard()
        wait_for("the sink hears more", lambda: self.heard() != before)

    def heard(self) -> str:
        """The last that the sink has said, on whatever machine."""
        command = f"journalctl -q -n 1 -o short-unix -t {NAME}/sink"
        return there(self.members.get("arm", "a"), command).stdout

    def pid(self, machine: str, pattern: str) -> str:
        """The process of the unit on a machine whose command line has `pattern`."""
        group = f"/sys/fs/cgroup/dora.slice/dora-{NAME}.service"
        command = f'\'for p in $(cat $(find {group} -name cgroup.procs)); do tr "\\0" " " '
        command += f'< /proc/$p/cmdline | grep -q -- "{pattern}" && echo $p; done\''
        found = there(machine, "sh", "-c", command).stdout.split()
        assert len(found) == 1, f"{pattern} on {machine}: {found}"
        return found[0]

    def kill(self, machine: str, pattern: str, signal: str = "KILL") -> None:
        """Send that process a signal."""
        assert there(machine, "kill", f"-{signal}", self.pid(machine, pattern)).returncode == 0

    def left(self) -> str:
        """What is left of it on any machine."""
        found = [f"{pid} {words}" for pid, words in dora_processes().items()]
        for machine in self.members.values():
            found += there(machine, "sh", "-c", _PROCESSES).stdout.splitlines()
        return "\n".join(found)

    def table(self) -> dict[str, dict[str, object]]:
        """The nodes as `list -o json` has them."""
        return {node["node"]: node for node in self.row()["nodes"]}

    def row(self) -> dict[str, Any]:
        """The dataflow as `list -o json` has it."""
        row: dict[str, Any] = json.loads(self.cell.doractl("list", NAME, "-o", "json").stdout)
        return row


def links() -> str:
    """The links of this machine, which end a moment after their dataflow."""
    return run("pgrep", "-af", "dora_systemd/link/", check=False).stdout


Kind = TypeVar("Kind", bound=Flow)


@contextmanager
def flow_on(flow: Kind, expected: Iterable[str] = ()) -> Iterator[Kind]:
    """The dataflow with its files everywhere.

    At its end it is stopped, nothing of it is left on any machine, and no journal has a warning
    other than those that are `expected`.
    """
    flow.bring()
    with quiet_journals(expected):
        try:
            yield flow
        finally:
            flow.cell.doractl("stop", NAME, check=False)
            flow.cell.end()
        wait_for("nothing is left", lambda: not (flow.left() or links()))
