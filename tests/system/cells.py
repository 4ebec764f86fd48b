"""A real dataflow in a real unit, as the system tests see it."""

import json
import os
import resource
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.decisions.cell.status import CellStatus
from dora_systemd.paths import CellPaths
from dora_systemd.scope import Scope, scope_of
from tests.lab.pace import bound, pace
from tests.system.tolerated import is_tolerated

T = TypeVar("T")

SOURCE = """
from dora import Node
import pyarrow as pa
node, count = Node(), 0
for event in node:
    if event["type"] == "INPUT":
        node.send_output("number", pa.array([count]))
        print("sent", count, flush=True)
        count += 1
"""
DOUBLER = """
from dora import Node
import pyarrow as pa
node = Node()
for event in node:
    if event["type"] == "INPUT":
        node.send_output("double", pa.array([2 * event["value"][0].as_py()]))
"""
# The queues are long: a loaded machine is no reason for dora to discard messages with a warning.
SINK = """
from dora import Node
node = Node()
for event in node:
    if event["type"] == "INPUT":
        print("got", event["value"].to_pylist(), flush=True)
"""
# A machine of the lab has little time to spare for how often a test polls and how often a node
# sends.
IS_SLOW = os.environ.get("LAB") in ("vm", "emulator")
TICK = f"dora/timer/millis/{250 if IS_SLOW else 100}"
POLL_SECONDS = 0.5 if IS_SLOW else 0.02
LONGEST_POLL_SECONDS = 1.0 if IS_SLOW else 0.2
DEAREST_POLL_SECONDS = 1.0
THREE_NODES = f"""
nodes:
  - id: source
    path: source.py
    inputs: {{tick: {TICK}}}
    outputs: [number]
  - id: doubler
    path: doubler.py
    inputs: {{number: {{source: source/number, queue_size: 1000}}}}
    outputs: [double]
  - id: sink
    path: sink.py
    inputs: {{double: {{source: doubler/double, queue_size: 1000}}}}
"""


def wait_for(what: str, condition: Callable[[], T], seconds: float = 30.0) -> T:
    """What `condition` gives as soon as that is true; fails after `seconds` of an idle machine."""
    begun, spent = time.monotonic(), processor_time()
    while not (value := condition()):
        waited, cost = time.monotonic() - begun, processor_time() - spent
        is_over = waited > seconds and waited > bound(seconds)
        assert not is_over, f"not within {seconds} s, {pace():.1f} times that here: {what}"
        # What takes long is polled less often, and so is what costs much: a poll can be a process,
        # and the other tests need the processor.
        pause = max(min(waited / 10, LONGEST_POLL_SECONDS), min(3 * cost, DEAREST_POLL_SECONDS))
        time.sleep(max(POLL_SECONDS, pause))
        spent = processor_time()
    return value


def processor_time() -> float:
    """Seconds that this process and the children that it has waited for have used."""
    used = map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in used)


def run(*command: str, check: bool = True, **options: Any) -> subprocess.CompletedProcess[str]:
    """A command's two streams; its failure fails the test, unless check is off."""
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, timeout=bound(120), **options
    )
    assert not check or done.returncode == 0, (
        f"{' '.join(command)}: {done.returncode}\n{done.stdout}{done.stderr}"
    )
    return done


def sync_journal() -> None:
    """Return when everything that was sent to journald can be read."""
    if os.geteuid() == 0:
        run("journalctl", "--sync")
        return
    # Others may not ask journald; what comes through its socket is handled in order.
    mark = f"MESSAGE=sync {time.monotonic_ns()}"
    journal = JournalSocket()
    journal.send(mark.encode() + b"\n")
    journal.close()
    wait_for("journald", lambda: run("journalctl", "-q", "-o", "cat", mark).stdout)


def journalctl(*words: str, check: bool = True) -> str:
    """What it prints, of everything that was sent to journald until now."""
    sync_journal()
    return run("journalctl", "--quiet", *words, check=check).stdout


class Project:
    """A directory with a dataflow, readable for everyone."""

    def __init__(self, root: Path, is_new: bool = True) -> None:
        self.root = root
        root.mkdir(exist_ok=not is_new)
        root.chmod(0o755)

    def write(self, name: str, text: str) -> Path:
        """Write a file of the project, which is its owner's."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o644)
        if os.geteuid() == 0:
            owner = self.root.stat()
            os.chown(path, owner.st_uid, owner.st_gid)
        return path

    def three_nodes(self) -> Path:
        """The dataflow source -> doubler -> sink."""
        for name, text in (("source", SOURCE), ("doubler", DOUBLER), ("sink", SINK)):
            self.write(f"{name}.py", text)
        return self.write("dataflow.yml", THREE_NODES)


NOT_LOADED = 5
"""Exit status of systemctl(1) for a unit that systemd does not know."""


class Cell:
    """The unit of dataflow `name`."""

    def __init__(self, name: str, scope: Scope | None = None) -> None:
        self.name = name
        self.unit = f"dora-{name}.service"
        self.scope = scope or scope_of(None)

    def doractl(self, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run doractl."""
        return run("doractl", self.scope.flag, *arguments, check=check)

    def start(
        self, dataflow: Path, *arguments: str, check: bool = True
    ) -> subprocess.CompletedProcess[str]:
        """`doractl start`, and how it went."""
        return self.doractl("start", str(dataflow), "--name", self.name, *arguments, check=check)

    def systemctl(self, *arguments: str, check: bool = True) -> str:
        """The output of `systemctl VERB UNIT ...`."""
        verb, *more = arguments
        return run("systemctl", self.scope.flag, verb, self.unit, *more, check=check).stdout

    def show(self, name: str) -> str:
        """A property of the unit as `systemctl show` prints it."""
        return self.systemctl("show", "--value", "--property", name).strip()

    @property
    def is_gone(self) -> bool:
        """Whether nothing of the unit runs."""
        return self.show("ActiveState") in ("inactive", "failed")

    @property
    def paths(self) -> CellPaths:
        """The files of the cell."""
        return CellPaths(self.scope.cell_directory(self.name))

    @property
    def status(self) -> CellStatus:
        """The live table."""
        return CellStatus.from_json(self.paths.status.read_text())

    @property
    def group(self) -> Path:
        """The unit's cgroup."""
        return cgroup.group_path(self.show("ControlGroup"))

    def pids(self, group: str) -> list[int]:
        """The processes of a group of the cell: "supervisor" or "node-ID"."""
        return cgroup.pids(self.group / group)

    def supervisor_pid(self, what: str) -> int:
        """The pid of the runner, the coordinator or the daemon."""
        words = {"runner": "dora_systemd.runner"}.get(what, what)
        found = [pid for pid in self.pids("supervisor") if words in command_line(pid)]
        assert len(found) == 1, f"{what}: {found}"
        return found[0]

    def all_pids(self) -> dict[int, str]:
        """Every process of the cell with its command line."""
        return {pid: " ".join(command_line(pid)) for pid in cgroup.pids(self.group)}

    def journal(self, *matches: str) -> list[dict[str, Any]]:
        """The records of the unit that match, oldest first."""
        which = "--user-unit" if self.scope.is_user else "--unit"
        lines = journalctl("-o", "json", "--all", which, self.unit, *matches).splitlines()
        return [json.loads(line) for line in lines]

    def last_words(self) -> str:
        """The live table, and the newest lines of the journal that no node has printed."""
        path = self.paths.status
        table = path.read_text() if path.exists() else "no live table"
        lines = [
            f"{int(one['__REALTIME_TIMESTAMP']) / 1e6:.1f} {one.get('MESSAGE')}"
            for one in self.journal()
            if "DORA_NODE" not in one or "DORA_EVENT" in one
        ]
        return "\n".join([table, *lines[-50:]])

    def messages(self, node: str) -> list[str]:
        """What a node has printed so far, without what dora says of a slow machine."""
        found = self.journal(f"DORA_NODE={node}")
        said = (str(one["MESSAGE"]) for one in found if "DORA_EVENT" not in one)
        return [line for line in said if not is_tolerated(line)]

    def events(self) -> list[tuple[str, str]]:
        """The life events so far: name and node."""
        return [
            (e["DORA_EVENT"], e.get("DORA_NODE", "")) for e in self.journal() if "DORA_EVENT" in e
        ]

    def wait_exchanging(self, node: str = "sink") -> None:
        """Return when `node` has printed something more than now."""
        before = len(self.messages(node))
        wait_for(f"{node} prints", lambda: len(self.messages(node)) > before)

    def end(self) -> None:
        """Leave nothing of the unit.

        On a machine without time to spare systemctl can give up before systemd has answered.
        """
        stop = ("systemctl", self.scope.flag, "stop", self.unit)
        wait_for("it is stopped", lambda: run(*stop, check=False).returncode in (0, NOT_LOADED))
        run("systemctl", self.scope.flag, "reset-failed", self.unit, check=False)


def command_line(pid: int) -> Sequence[str]:
    """The words of a process's command line; none for one that has just gone."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
    except OSError:
        return ()


def is_alive(pid: int) -> bool:
    """Whether the process is there and no zombie."""
    try:
        return ") Z " not in Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False


def dora_processes() -> dict[int, str]:
    """Every process of this user that belongs to any dataflow."""
    found = {int(p.name): " ".join(command_line(int(p.name))) for p in Path("/proc").glob("[0-9]*")}
    return {
        pid: words
        for pid, words in found.items()
        if pid != os.getpid()
        and (
            "dora_systemd.runner" in words or "dora coordinator" in words or "dora daemon" in words
        )
    }


def wait_no_process() -> None:
    """Wait until no process of any dataflow is left; the failure says which are, and where."""
    try:
        wait_for("no process is left", lambda: not dora_processes())
    except AssertionError as error:
        left = [f"{pid} {words}: {group_of(pid)}" for pid, words in dora_processes().items()]
        raise AssertionError("\n".join([str(error), *left])) from error


def group_of(pid: int) -> str:
    """The cgroup of a process, "" if it has just gone."""
    try:
        return Path(f"/proc/{pid}/cgroup").read_text().strip()
    except OSError:
        return ""
