"""Carries out the steps of a history, and records what comes of them."""

import contextlib
import json
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dora_systemd.adapters.releases.store import store_root
from dora_systemd.decisions.cell.status import NodeStatus, is_stopping
from tests.history import member
from tests.history.history import Answer, History, Look
from tests.history.recorder import (
    Watcher,
    journal_lines,
    lost_lines,
    pids_of,
    properties,
    restart_times,
    view_of,
    vitals,
)
from tests.history.scene import Scene, inventory
from tests.history.steps import CELLS, FAULTS, LOOK, Step, shell_of
from tests.lab.pace import bound, pace
from tests.system.cells import Cell, run, wait_for, wait_no_process

QUIET_SECONDS = 40.0
LOOKS = 5
"""A look during which something changed, as a node ending late, is taken again."""
HUNG_SECONDS = 120.0
ALIVE = frozenset({"running", "ready", "finished", "stopped", "failed"})
END = ("doractl destroy", *(f"doractl disable {cell}" for cell in CELLS), "doractl reset --all")
"""The commands that end a history; `disable` fails where systemd knows no such dataflow."""


@dataclass
class Running:
    """A step that has begun."""

    at: int
    step: Step
    process: subprocess.Popen[str]
    begun: float
    was_hit: bool = False

    def finish(self) -> Answer:
        """How it went, when it has ended; one that hangs is killed, which the checker sees."""
        try:
            out, err = self.process.communicate(timeout=bound(HUNG_SECONDS))
        except subprocess.TimeoutExpired:
            self.process.kill()
            out, err = self.process.communicate()
        status, now = self.process.returncode, time.monotonic()
        return Answer(self.at, self.step, status, out, err, self.begun, now, self.was_hit)


class Driver:
    """One history on this machine, which has no dataflow yet."""

    def __init__(self, root: Path) -> None:
        self.scene = Scene(root)
        self._running: list[Running] = []
        self._undo: list[tuple[str, str]] = []
        self._answers: list[Answer] = []
        self._looks: list[Look] = []

    def carry_out(self, steps: Sequence[Step]) -> History:
        """The history of these steps; nothing of it is left on the machine but the journal."""
        since = time.time()
        self.scene.front.up()
        before = inventory()
        with Watcher(self.scene) as watcher:
            try:
                for at, step in enumerate(steps):
                    self._do(at, step)
                self.settle()
            finally:
                end = self._end()
        run("journalctl", "--sync")
        return History(
            tuple(steps),
            tuple(self._answers),
            tuple(watcher.sights),
            tuple(self._looks),
            self.scene.printed(),
            tuple(journal_lines(since)),
            {cell: lost_lines(cell, since) for cell in CELLS},
            tuple(sorted(inventory() - before)),
            tuple(end),
            {cell: restart_times(cell, since) for cell in CELLS},
            {cell: _ran(cell) for cell in CELLS},
        )

    def _do(self, at: int, step: Step) -> None:
        if step.what == LOOK:
            self.settle()
            self._looks.append(self._look(at))
            return
        if not step.is_joined:
            self._finish()
        time.sleep(step.pause_ms / 1000)  # a part of the history; nothing is waited for
        self._begin(at, step)

    def _begin(self, at: int, step: Step) -> None:
        if step.what.endswith("-doractl"):
            for one in self._running:
                one.was_hit = True
        if step.what in FAULTS and FAULTS[step.what].undo:
            self._undo.append((FAULTS[step.what].undo, step.cell))
        # One that hits may still look for its target when the next command begins.
        may_be_hit = any(one.step.what.endswith("-doractl") for one in self._running)
        process = self.scene.begin(shell_of(step.what), step.cell)
        self._running.append(Running(at, step, process, time.monotonic(), may_be_hit))

    def _finish(self) -> None:
        """Wait for all steps that run; a doractl that is stopped goes on first."""
        if any(one.what == "stop-doractl" for one in self._finish_faults()):
            self._shell("thaw")
        self._answers += [one.finish() for one in self._running]
        self._running.clear()

    def _finish_faults(self) -> list[Step]:
        """Wait for the faults that run; what they stop after a `thaw` would stay stopped."""
        faults = [one for one in self._running if one.step.what in FAULTS]
        self._answers += [one.finish() for one in faults]
        self._running = [one for one in self._running if one not in faults]
        return [one.step for one in faults]

    def settle(self) -> None:
        """Take the faults back, and wait for what runs."""
        self._finish_faults()
        if any(undo == "thaw" for undo, _ in self._undo):
            self._shell("thaw")
        self._finish()
        for undo, cell in reversed(self._undo):
            self._shell(undo, cell)
        self._undo.clear()

    def _shell(self, text: str, cell: str = CELLS[0]) -> tuple[int, str, str]:
        process = self.scene.begin(text, cell)
        out, err = process.communicate(timeout=bound(HUNG_SECONDS))
        return process.returncode, out, err

    def _look(self, at: int) -> Look:
        """One that saw nothing change, if such a one can be had."""
        for _ in range(LOOKS):
            root = self.scene.root
            is_quiet, before = _becomes_quiet(root), _states(root)
            metrics = self.scene.front.get("/metrics").body
            cells = {cell: view_of(cell, metrics) for cell in CELLS}
            if before == _states(root) or not is_quiet:
                break
        else:
            is_quiet = False
        return Look(at, is_quiet, pace(), cells, vitals(dict(cells)), time.monotonic())

    def _end(self) -> list[Answer]:
        """End everything with the commands that are made for it."""
        self.settle()
        answers = []
        for text in END:
            status, out, err = self._shell(text)
            answers.append(Answer(-1, Step(text), status, out, err))
        wait_no_process()
        member.wait_nothing_left()
        return answers

    def clean(self) -> None:
        """Leave the machine as it was, whatever came before."""
        for one in self._running:
            one.process.kill()
        self._shell("thaw; empty_run")
        for cell in CELLS:
            Cell(cell).doractl("disable", cell, check=False)
            Cell(cell).end()
            shutil.rmtree(store_root() / cell, ignore_errors=True)
        member.forget(self.scene.root)
        self.scene.front.end()


def _ran(cell: str) -> tuple[dict[str, Any], ...]:
    """What ran of a dataflow that was deployed, oldest first."""
    done = Cell(cell).doractl("releases", cell, "--history", "-o", "json", check=False)
    return tuple(json.loads(done.stdout)[::-1]) if done.returncode == 0 else ()


def _becomes_quiet(root: Path) -> bool:
    """Whether nothing changes any more, within the bound; twice the same is quiet."""
    last: list[dict[str, str]] = []

    def is_quiet() -> bool:
        nonlocal last
        now = _states(root)
        is_same, last = now == last, now
        return is_same and all(map(_is_steady, now))

    try:
        return wait_for("quiet", is_quiet, QUIET_SECONDS)
    except AssertionError:
        return False


def _states(root: Path) -> list[dict[str, str]]:
    return [_state_of(cell, root / cell / "project") for cell in CELLS]


def _state_of(cell: str, project: Path) -> dict[str, str]:
    found = properties(f"dora-{cell}.service")
    status = None
    with contextlib.suppress(FileNotFoundError):  # its directory goes with the dataflow
        status = Cell(cell).status
    states = status.nodes.values() if status else ()
    found["nodes"] = " ".join(map(_word, states))
    # Two looks between restarts of a node in vain see the same state.
    found["restarts"] = " ".join(str(one.restarts) for one in states)
    # A node can have died a moment before the runner hears of it.
    found["pids"] = str({at: one for at, one in pids_of(found).items() if at.startswith("node-")})
    found["stage"] = status.stage if status else ""
    found["old"] = "yes" * _has_old_directory(project / "node.py", found["MainPID"])
    return found


def _has_old_directory(file: Path, pid: str) -> bool:
    """Whether another directory has the name of the project since the start.

    The old one is mounted for the nodes, and empty. dora tries in vain to restart one of them until
    somebody restarts the dataflow.
    """
    return file.exists() and pid != "0" and not Path(f"/proc/{pid}/root{file}").exists()


def _word(node: NodeStatus) -> str:
    """Its state; a node that was stopped has its grace duration to end."""
    return "stopping" if is_stopping(node) else node.state


def _is_steady(state: dict[str, str]) -> bool:
    if state.get("Job", "0") not in ("", "0"):
        return False
    if state["ActiveState"] in ("inactive", "failed"):
        return True
    is_up = state["ActiveState"] == "active" and state["stage"] in ("running", "degraded")
    steady = ALIVE | {"restarting"} if state["old"] else ALIVE
    return is_up and set(state["nodes"].split()) <= steady
