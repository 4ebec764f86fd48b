"""What is seen of the machine while a history happens."""

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dora_systemd.adapters.cgroup import groups as cgroup
from tests.history import member
from tests.history.history import CellView, Line, Sight, Vital
from tests.history.scene import Scene, ask
from tests.history.steps import CELLS
from tests.system.cells import run

SAMPLE_SECONDS = 0.1
PROPERTIES = (
    *("ActiveState", "SubState", "NRestarts", "InvocationID", "MainPID", "ControlGroup", "Result"),
    *("LoadState", "Job", "StatusText", "ExecMainStatus"),
)
RESTART_SCHEDULED = "5eb03494b6584870a536b337290809b3"
"""SD_MESSAGE_UNIT_RESTART_SCHEDULED, see sd-messages.h."""
SERVICES = {"journald": "systemd-journald.service", "gateway": "dora-gateway.service"}


_OF_DEPLOY = "/dora.slice/doractl-"
"""Units in which a deploy checks and builds a release, before any life of it."""


class Watcher:
    """Looks at all processes of the cells again and again, in a thread of its own."""

    def __init__(self, scene: Scene) -> None:
        self._marks = {cell: f"NOTES={scene.notes(cell)}".encode() for cell in CELLS}
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self.sights: list[tuple[Sight, ...]] = []

    def __enter__(self) -> "Watcher":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._is_over.wait(SAMPLE_SECONDS):
            self.scan()

    def scan(self) -> tuple[Sight, ...]:
        """All processes of cells, in the order in which they are seen; kept if it is new."""
        scan = tuple(self._sights())
        if not self.sights or scan != self.sights[-1]:
            self.sights.append(scan)
        return scan

    def _sights(self) -> Iterator[Sight]:
        for directory in Path("/proc").glob("[0-9]*"):
            try:
                environment = (directory / "environ").read_bytes().split(b"\0")
                for cell, mark in self._marks.items():
                    if mark in environment:
                        sight = _sight(cell, directory, environment)
                        yield from () if _OF_DEPLOY in sight.group else (sight,)
            except (OSError, IndexError):
                continue  # it has ended meanwhile


def _sight(cell: str, directory: Path, environment: list[bytes]) -> Sight:
    known = (one.partition(b"=") for one in environment)
    invocation = {key: value.decode() for key, _, value in known}.get(b"INVOCATION_ID", "")
    group = (directory / "cgroup").read_text().strip().rpartition(":")[2]
    return Sight(cell, int(directory.name), _began(directory), invocation, group, time.monotonic())


def _began(directory: Path) -> int:
    return int((directory / "stat").read_text().rpartition(") ")[2].split()[19])


def properties(unit: str) -> dict[str, str]:
    """What systemd says of a unit."""
    shown = run("systemctl", "show", unit, f"--property={','.join(PROPERTIES)}").stdout
    return dict(line.split("=", 1) for line in shown.splitlines() if "=" in line)


def vital(pid: int) -> Vital | None:
    """What a process holds; None if it is gone."""
    directory = Path(f"/proc/{pid}")
    try:
        lines = (directory / "status").read_text().splitlines()
        (memory,) = (int(line.split()[1]) for line in lines if line.startswith("RssAnon"))
        count = len(list((directory / "fd").iterdir()))
        return Vital(pid, _began(directory), memory, count)
    except (OSError, ValueError):
        return None


def vitals(cells: dict[str, CellView]) -> dict[str, Vital]:
    """The same of PID 1, journald, the gateway and the runners."""
    pids = {name: int(properties(unit)["MainPID"]) for name, unit in SERVICES.items()}
    runners = {f"runner {cell}": int(view.unit["MainPID"]) for cell, view in cells.items()}
    found = {name: vital(pid) for name, pid in ({"PID 1": 1} | pids | runners).items() if pid}
    return {name: one for name, one in found.items() if one is not None}


def view_of(cell: str, metrics: str) -> CellView:
    """What everyone says of a cell. metrics: the text of /metrics."""
    unit = properties(f"dora-{cell}.service")
    rows = ask("list", "--all") or []
    listed = next((row for row in rows if row.get("name") == cell), None)
    why = ask("why", cell)
    why = why if isinstance(why, dict) and "summary" in why else None
    return CellView(unit, listed, why, _metrics(metrics, cell), pids_of(unit))


def _metrics(text: str, cell: str) -> dict[str, float]:
    found = {}
    for line in text.splitlines():
        series, _, value = line.rpartition(" ")
        if f'{{dataflow="{cell}"' in series and series.startswith("dora_dataflow_"):
            found[series.replace(f'dataflow="{cell}",', "").replace(f'dataflow="{cell}"', "")] = (
                float(value)
            )
    return found


def pids_of(unit: dict[str, str]) -> dict[str, tuple[int, ...]]:
    """The processes of a unit, by its groups."""
    if not unit.get("ControlGroup"):
        return {}
    root = cgroup.group_path(unit["ControlGroup"])
    return {one.name: tuple(cgroup.pids(one)) for one in root.glob("*/") if one.is_dir()}


def journal_lines(since: float) -> list[Line]:
    """The numbered lines of all cells, as journald has them."""
    run("journalctl", "--sync")
    return [line for cell in CELLS for line in _lines_of(cell, since)]


def _lines_of(cell: str, since: float) -> Iterator[Line]:
    where = (f"DORA_DATAFLOW_NAME={cell}", "DORA_STREAM=stdout", f"--since=@{since:.6f}")
    for one in _records(cell, *where):
        life, _, number = str(one.get("MESSAGE", "")).partition(" ")
        if life.partition(".")[0] in ("source", "sink") and number.isdecimal():
            yield Line(cell, life, int(number), one.get("_SYSTEMD_UNIT") == f"dora-{cell}.service")


def _records(cell: str, *where: str) -> Iterator[dict[str, Any]]:
    """What the journals of all machines have of a cell."""
    arguments = ("-q", "-o", "json", *where)
    texts = (run("journalctl", *arguments).stdout, member.journal(cell, *arguments))
    yield from (json.loads(line) for text in texts for line in text.splitlines())


def restart_times(cell: str, since: float) -> tuple[float, ...]:
    """When systemd has said that it restarts the unit by itself, CLOCK_MONOTONIC."""
    where = (f"UNIT=dora-{cell}.service", f"MESSAGE_ID={RESTART_SCHEDULED}", "_PID=1")
    found = run("journalctl", "-q", "-o", "json", *where, f"--since=@{since:.6f}").stdout
    records = map(json.loads, found.splitlines())
    return tuple(int(one["__MONOTONIC_TIMESTAMP"]) / 1e6 for one in records)


def lost_lines(cell: str, since: float) -> int:
    """How many lines the journal has counted as lost."""
    where = (f"--unit=dora-{cell}.service", "DORA_EVENT=lines-lost", f"--since=@{since:.6f}")
    return sum(int(one["DORA_COUNT"]) for one in _records(cell, *where))
