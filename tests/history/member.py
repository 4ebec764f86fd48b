"""The second machine of a history with LAB=machines: it runs the sink of the first dataflow.

Everywhere else there is none, and nothing here has an effect.
"""

import os
import subprocess
from pathlib import Path

from tests.history.steps import CELLS, MACHINES
from tests.machines.wires import ask, there, wait_up
from tests.system.cells import wait_for

HOST = "b"
IS_THERE = os.environ.get("LAB") == MACHINES
_SPREAD = CELLS[0]
_LEFT = (
    "systemctl list-units --all --plain --no-legend 'dora-*'; pgrep -af '[n]ode.py (source|sink)'"
)


def placement(cell: str) -> str:
    """What the descriptor of a dataflow says of its last node."""
    return f"    deploy: {{machine: {HOST}}}\n" if is_spread(cell) else ""


def settings(notes: Path) -> str:
    """The settings file of that dataflow; a node elsewhere cannot wait for a device."""
    return f"machines: {{{HOST}: {{writable: [{notes}]}}}}\n"


def bring(root: Path) -> None:
    """The project at the same place."""
    if not IS_THERE:
        return
    _must(f"mkdir -p {root}")
    copy = ("scp", "-q", "-r", str(root / _SPREAD), f"root@{HOST}:{root}")
    subprocess.run(copy, check=True)
    _must(f"chmod 755 {root} && chmod 777 {root}/{_SPREAD}/notes")


def read_notes(place: Path, cell: str) -> dict[str, str]:
    """The notes of the nodes there, by name."""
    found = _must(f"grep -s . {place}/*.* /dev/null; true") if is_spread(cell) else ""
    lines = (line.rpartition(":") for line in found.splitlines())
    return {path.rpartition("/")[2]: text for path, _, text in lines}


def journal(cell: str, *arguments: str) -> str:
    """What journalctl says there."""
    words = " ".join(f"'{one}'" for one in arguments)
    return _must(f"journalctl --sync; journalctl {words}") if is_spread(cell) else ""


def wait_nothing_left() -> None:
    """Its part ends a moment after that of the head."""
    if IS_THERE:
        wait_for("nothing is left on the member", lambda: not there(HOST, _LEFT).stdout, 30)


def forget(root: Path) -> None:
    """Leave nothing there, whatever came before."""
    if not IS_THERE:
        return
    ask("cable", HOST, "on")
    wait_up(HOST)
    there(HOST, f"pkill -CONT -f dora_systemd; doractl destroy --force; rm -rf {root}")


def is_spread(cell: str) -> bool:
    """Whether the last node of a dataflow is there."""
    return IS_THERE and cell == _SPREAD


def _must(command: str) -> str:
    done = there(HOST, command)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout
