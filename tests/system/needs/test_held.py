"""A dataflow whose start systemd holds, because another unit is not there yet."""

import json
import shlex
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.cells import Cell, Project, run, wait_for
from tests.system.gateways import Front
from tests.system.needs.scene import seen, wait_running
from tests.system.needs.test_units import one_node


class Door:
    """A unit that is on its way up until open()."""

    def __init__(self, cell: Cell, place: Path) -> None:
        self.unit = f"{cell.name[:50]}-door.service"
        self._flag, self._path = cell.scope.flag, place / "open"
        wait = f"until test -e {shlex.quote(str(self._path))}; do sleep 0.05; done"
        words = ("--service-type=oneshot", "--remain-after-exit", "--collect", "--no-block")
        run("systemd-run", self._flag, *words, f"--unit={self.unit}", "sh", "-c", wait)

    def open(self) -> None:
        self._path.touch()
        wait_for("the door is open", lambda: self.state == "active")

    def restart(self) -> None:
        """Close it, while it is on its way up again."""
        self._path.unlink()
        run("systemctl", self._flag, "restart", "--no-block", self.unit)

    @property
    def state(self) -> str:
        return run("systemctl", self._flag, "is-active", self.unit, check=False).stdout.strip()

    def end(self) -> None:
        run("systemctl", self._flag, "stop", self.unit)


@pytest.fixture
def door(cell: Cell, place: Path) -> Iterator[Door]:
    door = Door(cell, place)
    yield door
    door.end()


def start_held(cell: Cell, project: Project, door: Door) -> str:
    """What a start that nobody waits for says."""
    done = cell.start(one_node(project), "--needs", f"unit:{door.unit}", "--no-wait")
    assert (cell.show("ActiveState"), cell.show("Job") != "0") == ("inactive", True)
    return done.stdout + done.stderr


def test_all_say_what_a_start_waits_for(
    cell: Cell, project: Project, door: Door, front: Front
) -> None:
    assert f"the start waits for {door.unit}" in start_held(cell, project, door)
    row = seen(cell)
    assert (row["status"], row["waits_for"], row["nodes"]) == ("Waiting", door.unit, [])
    text = f"the start waits for {door.unit} since {row['waits_since'][:10]} "
    assert row["text"].startswith(text)
    made = Path(cell.show("FragmentPath")).stat().st_mtime_ns // 1000
    assert row["waits_since_us"] == made
    assert f"Status:   Waiting ({text}" in cell.doractl("list", cell.name).stdout
    (line,) = cell.doractl("list", check=False).stdout.splitlines()[1:]
    assert line.split()[1:3] == [cell.name, "Waiting"]
    assert text in line
    why = cell.doractl("why", cell.name).stdout
    assert why.startswith(f"{cell.name}: Waiting\n  Now:      {text}"), why
    front.up()
    waiting = f'dora_dataflow_state{{dataflow="{cell.name}",state="waiting"}} 1'
    assert waiting in front.get("/metrics").body.splitlines()
    again = cell.start(project.root / "dataflow.yml", check=False)
    assert "of that name waits for its start" in again.stderr
    refused = cell.doractl("node", "restart", cell.name, "sink", check=False)
    assert "systemd has not started it yet" in refused.stderr
    door.open()
    wait_running(cell)
    assert (seen(cell)["waits_for"], seen(cell)["waits_since"]) == (None, None)


def test_a_stop_cancels_a_start_that_waits(cell: Cell, project: Project, door: Door) -> None:
    start_held(cell, project, door)
    done = json.loads(cell.doractl("stop", cell.name, "-o", "json").stdout)
    assert "Dataflow stopped" in done["text"]
    door.open()
    assert cell.show("LoadState") == "not-found"
    assert f"no dataflow named '{cell.name}'" in cell.doractl("stop", cell.name, check=False).stderr


def test_a_restart_of_what_it_needs_is_told(cell: Cell, project: Project, door: Door) -> None:
    """systemd stops it, and queues its start behind that of the other unit."""
    door.open()
    cell.start(one_node(project), "--needs", f"unit:{door.unit}")
    begun = time.time_ns() // 1000
    door.restart()
    wait_for("it waits", lambda: seen(cell)["waits_for"] == door.unit)
    assert begun <= seen(cell)["waits_since_us"] <= time.time_ns() // 1000
    assert "Before:   stopped by" in cell.doractl("why", cell.name).stdout
    door.open()
    wait_running(cell)
    cell.doractl("stop", cell.name)
