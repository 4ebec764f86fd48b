"""One dataflow on a, the head, and b, its machine gpu."""

import json
import subprocess
from collections.abc import Iterator

from tests.machines.wires import there
from tests.system.cells import Cell, run, wait_for

FILE = "/src/tests/machines/flow/dataflow.yml"
GRACE = 2
"""Seconds."""
_FLAGS = ("--machine", "gpu=b", "--restart-policy", "on-failure", "--grace-duration", f"{GRACE}s")
_OURS = "dora daemon|dora coordinator|dora_systemd[.]runner|dora_systemd[.]link|flow/[a-z]+[.]py"


class Flow(Cell):
    """The part on the head; `there` is about the other one."""

    def begin(self, *more: str) -> subprocess.CompletedProcess[str]:
        """Start it on both machines."""
        return self.doractl("start", FILE, "--name", self.name, *_FLAGS, *more, check=False)

    @property
    def life(self) -> tuple[str, str]:
        """What changes with each life of the head, and with each run of dora."""
        return self.show("InvocationID"), self.status.run

    def on_b(self, name: str) -> str:
        """A property of the unit there."""
        command = ("systemctl", "show", "--value", "--property", name, self.unit)
        return there("b", *command).stdout.strip()

    def kill_on_b(self, what: str) -> None:
        """SIGKILL for a process there, by a pattern that does not match the shell around it."""
        pattern = f"[{what[0]}]{what[1:]}"
        assert there("b", "pkill", "-KILL", "-f", f"'{pattern}'").returncode == 0, what

    def is_running(self) -> bool:
        """Whether both parts are up."""
        return self.show("ActiveState") == "active" and self.on_b("ActiveState") == "active"

    def wait_running(self) -> None:
        """Return when messages cross the machines."""
        wait_for("both machines run", self.is_running, 60)
        self.wait_exchanging()

    def waits(self) -> bool:
        """Whether the head says that it waits for the other one."""
        return self.show("StatusText").startswith("waiting for machine gpu (")

    def reasons(self) -> list[str]:
        """Why lives of the head have failed, oldest first."""
        records = self.journal("DORA_EVENT=dataflow-failed")
        return [str(one.get("DORA_REASON", "")) for one in records]

    def close(self) -> None:
        """Stop it, and see that nothing is left on any machine."""
        self.doractl("stop", self.name, check=False)
        wait_for("nothing is left", lambda: not any(left_on(name) for name in ("a", "b", "c")))


def left_on(name: str) -> list[str]:
    """Our processes on a machine."""
    command = ("pgrep", "-fa", _OURS)
    done = run(*command, check=False) if name == "a" else there(name, "pgrep", "-fa", f"'{_OURS}'")
    found = done.stdout.splitlines()
    return [line for line in found if "pgrep" not in line]


def listeners(name: str) -> set[str]:
    """Where a machine listens, but for loopback."""
    command = ("ss", "-Hltn")
    found = run(*command).stdout if name == "a" else there(name, *command).stdout
    places = {line.split()[3] for line in found.splitlines()}
    return {place for place in places if not place.startswith("127.0.0.1:")}


def lifetime(flow: Flow) -> Iterator[Flow]:
    """A fixture's block: it runs before, and nothing of it is left after."""
    done = flow.begin()
    assert done.returncode == 0, done.stderr
    flow.wait_running()
    yield flow
    flow.close()


def rows(name: str) -> dict[str, dict[str, object]]:
    """The nodes in `list -o json`."""
    found = json.loads(run("doractl", "list", name, "-o", "json").stdout)
    return {one["id"]: one for one in found["nodes"]}
