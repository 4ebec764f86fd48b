"""Locks that inhibit restarts: who holds them, who is refused, and what a hostile owner can do."""

import errno
import fcntl
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Timer

import pytest

from dora_systemd.decisions.cell.environment import LOCK_VARIABLE, node_environment
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.runner.cell.begin import make_lock
from dora_systemd.verbs.facts.cells import Cell, read_cells
from dora_systemd.verbs.facts.locks import (
    IfInhibited,
    read_holders,
    require_uninhibited,
    uninhibited,
)
from dora_systemd.verbs.inhibit import Lock, hold, inhibited_dataflows, take_inhibiting
from tests.unit.fakes.manager import FakeManager, ScopeIn, options


@pytest.fixture
def scope(tmp_path: Path) -> ScopeIn:
    return ScopeIn(is_user=True, uid=os.getuid(), root=tmp_path)


@pytest.fixture
def cell(manager: FakeManager) -> Cell:
    manager.add(options())
    (cell,) = read_cells(manager)
    return cell


@pytest.fixture
def lock(scope: ScopeIn) -> Path:
    """The lock file of the dataflow, as the runner makes it."""
    path = scope.cell_directory("robot") / "inhibit.lock"
    path.parent.mkdir(parents=True)
    make_lock(path)
    return path


@contextmanager
def locked(path: Path, operation: int = fcntl.LOCK_SH) -> Iterator[int]:
    """A lock as a node holds it."""
    with path.open("a") as file:
        fcntl.flock(file, operation | fcntl.LOCK_NB)
        yield file.fileno()


def test_the_file_is_in_the_environment_of_nodes(tmp_path: Path) -> None:
    found = node_environment({"RUNTIME_DIRECTORY": str(tmp_path), LOCK_VARIABLE: "/of/the/caller"})
    assert found == {LOCK_VARIABLE: str(tmp_path / "inhibit.lock")}


def test_a_new_runner_makes_a_new_file(lock: Path) -> None:
    """A node that starts must not wait for the restart that has started it."""
    with locked(lock, fcntl.LOCK_EX):
        make_lock(lock)
        with locked(lock, fcntl.LOCK_EX):
            assert lock.stat().st_mode & 0o777 == 0o600


def test_nobody_inhibits(scope: ScopeIn, cell: Cell, lock: Path) -> None:
    with uninhibited(scope, [cell], "restart"), pytest.raises(BlockingIOError), locked(lock):
        raise AssertionError("a lock was taken during a restart")
    with locked(lock):
        pass
    assert read_holders(scope, ["robot"]) == {}


def test_a_dataflow_of_an_older_runner_has_no_file(scope: ScopeIn, cell: Cell) -> None:
    require_uninhibited(scope, [cell], "restart")
    with pytest.raises(DoraSystemdError, match="cannot inhibit robot: it has no lock file"):
        take_inhibiting(scope, cell, "why")


@pytest.mark.parametrize("operation", [fcntl.LOCK_SH, fcntl.LOCK_EX])
def test_a_lock_inhibits(operation: int, scope: ScopeIn, cell: Cell, lock: Path) -> None:
    with locked(lock, operation) as file:
        os.write(file, f"{os.getpid()} first\n{os.getpid()} it is driving\n".encode())
        with pytest.raises(DoraSystemdError) as caught:
            require_uninhibited(scope, [cell], "restart")
        (holder,) = read_holders(scope, ["robot", "other"])["robot"]
    assert caught.value.code is ExitCode.INHIBITED
    assert caught.value.message.startswith("cannot restart robot: inhibited by ")
    assert caught.value.message.endswith(": it is driving")
    assert "--force" in caught.value.hint
    assert (holder.pid, holder.why) == (os.getpid(), "it is driving")
    assert Path(sys.executable).name in holder.command
    require_uninhibited(scope, [cell], "restart")


def test_the_reasons_of_others_do_not_count(scope: ScopeIn, lock: Path) -> None:
    with locked(lock) as file:
        os.write(file, b"\xff\n1 not mine\n99999999999999999999 x\n-1 x\n\n" + b"x" * 100_000)
        (holder,) = read_holders(scope, ["robot"])["robot"]
    assert holder.why == ""


@pytest.mark.usefixtures("lock")
def test_a_file_system_without_locks(
    monkeypatch: pytest.MonkeyPatch, scope: ScopeIn, cell: Cell
) -> None:
    """Nobody inhibits it then, and nobody knows that."""

    def refuse(*_: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(DoraSystemdError) as caught:
        require_uninhibited(scope, [cell], "restart")
    assert caught.value.message.startswith("cannot lock /")
    assert caught.value.message.endswith(": No locks available")
    assert "--force" in caught.value.hint
    with pytest.raises(DoraSystemdError, match="cannot lock"):
        Lock(scope.cell_directory("robot"), "x").take()
    require_uninhibited(scope, [cell], "restart", IfInhibited.FORCE)


def test_force(scope: ScopeIn, cell: Cell, lock: Path) -> None:
    with locked(lock):
        with pytest.raises(DoraSystemdError, match="cannot restart robot: inhibited"):
            require_uninhibited(scope, [cell], "restart")
        require_uninhibited(scope, [cell], "restart", IfInhibited.FORCE)


def test_waiting_tells_for_whom(scope: ScopeIn, cell: Cell, lock: Path) -> None:
    said: list[str] = []
    file = lock.open("a")
    fcntl.flock(file, fcntl.LOCK_SH)
    timer = Timer(0.3, file.close)
    timer.start()
    require_uninhibited(scope, [cell], "restart", IfInhibited.WAIT, said.append)
    timer.join()
    (text,) = {*said}
    assert "inhibited by" in text


def test_who_waits_keeps_nobody_from_a_lock(scope: ScopeIn, manager: FakeManager) -> None:
    """Of two dataflows the second is inhibited: meanwhile the first one can be locked."""
    paths = []
    for name in ("a", "b"):
        manager.add(options(name))
        paths.append(scope.cell_directory(name) / "inhibit.lock")
        paths[-1].parent.mkdir(parents=True)
        make_lock(paths[-1])

    said: list[str] = []

    def told(text: str) -> None:
        with locked(paths[0]):
            said.append(text)
        file.close()

    file = paths[1].open("a")
    fcntl.flock(file, fcntl.LOCK_SH)
    require_uninhibited(scope, read_cells(manager), "restart", IfInhibited.WAIT, told)
    assert [text.partition(":")[0] for text in said] == ["cannot restart b"]


def test_a_lock_ends_with_its_process(scope: ScopeIn, cell: Cell, lock: Path) -> None:
    script = "import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, 1); print(flush=1); input()"
    command = [sys.executable, "-c", script, str(lock)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as child:
        assert child.stdout
        child.stdout.readline()
        with pytest.raises(DoraSystemdError, match=f"PID {child.pid}, "):
            require_uninhibited(scope, [cell], "restart")
        child.kill()
    require_uninhibited(scope, [cell], "restart")


def test_a_child_that_outlives_the_holder_inhibits(scope: ScopeIn, cell: Cell, lock: Path) -> None:
    """The kernel names a process that has gone; the lock counts nevertheless."""
    script = (
        "import fcntl, os, sys, time; f = open(sys.argv[1]); fcntl.flock(f, 1)\n"
        "if not os.fork(): print(os.getpid(), flush=True); time.sleep(600)"
    )
    done = subprocess.Popen([sys.executable, "-c", script, str(lock)], stdout=subprocess.PIPE)
    assert done.stdout
    child = int(done.stdout.readline())
    done.wait()
    done.stdout.close()
    try:
        with pytest.raises(DoraSystemdError, match="cannot restart robot: inhibited by"):
            require_uninhibited(scope, [cell], "restart")
    finally:
        os.kill(child, signal.SIGKILL)


def secret_beside(lock: Path) -> Path:
    path = lock.with_name("secret")
    path.write_text("secret")
    return path


HOSTILE: dict[str, Callable[[Path], object]] = {
    "link": lambda path: path.symlink_to(secret_beside(path)),
    "hard link": lambda path: path.hardlink_to(secret_beside(path)),
    "fifo": os.mkfifo,
    "directory": lambda path: path.mkdir(),
    "socket": lambda path: socket.socket(socket.AF_UNIX).bind(str(path)),
}


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("kind", HOSTILE)
def test_what_is_no_file_is_not_followed(
    kind: str, scope: ScopeIn, cell: Cell, lock: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock.unlink()
    HOSTILE[kind](lock)
    assert read_holders(scope, ["robot"]) == {}
    with pytest.raises(DoraSystemdError):
        take_inhibiting(scope, cell, "why")
    assert all(one.read_text() == "secret" for one in lock.parent.glob("secret"))
    other = lock.with_name("other")
    make_lock(other)
    with locked(other), pytest.raises(DoraSystemdError) as caught:
        require_uninhibited(scope, [cell], "restart")
    monkeypatch.setattr("dora_systemd.verbs.facts.locks.read_cell_flocks", lambda _: {})
    require_uninhibited(scope, [cell], "restart")  # no lock is held anywhere near
    assert "--force" in caught.value.hint
    assert str(lock) in caught.value.message


def test_a_lease_does_not_hold_up(scope: ScopeIn, cell: Cell, lock: Path) -> None:
    """The owner of a file can have a lease on it, which lets others wait 45 s to open it."""
    script = (
        "import fcntl, signal, sys; signal.signal(signal.SIGIO, signal.SIG_IGN)\n"
        "f = open(sys.argv[1], 'r+'); fcntl.fcntl(f, fcntl.F_SETLEASE, fcntl.F_WRLCK)\n"
        "print(flush=1); input()"
    )
    command = [sys.executable, "-c", script, str(lock)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as child:
        assert child.stdout
        child.stdout.readline()
        with pytest.raises(DoraSystemdError, match="inhibit"):
            take_inhibiting(scope, cell, "why")
        child.kill()


def test_a_command_that_is_inhibiting(
    scope: ScopeIn, cell: Cell, lock: Path, manager: FakeManager
) -> None:
    held = take_inhibiting(scope, cell, "mission 12")
    assert [one.name for one in inhibited_dataflows(manager, scope)] == ["robot"]
    (holder,) = read_holders(scope, ["robot"])["robot"]
    assert (holder.pid, holder.why) == (os.getpid(), "mission 12")
    assert hold(held, ["sh", "-c", "exit 3"]) == 3
    assert read_holders(scope, ["robot"]) == {}
    assert hold(take_inhibiting(scope, cell, "x"), ["sh", "-c", "kill -9 $$"]) == 128 + 9
    with pytest.raises(DoraSystemdError, match="cannot run /nowhere: No such file"):
        hold(take_inhibiting(scope, cell, "x"), ["/nowhere"])
    assert read_holders(scope, ["robot"]) == {}
    assert lock.exists()


def test_two_may_inhibit(scope: ScopeIn, cell: Cell, lock: Path) -> None:
    with locked(lock):
        take_inhibiting(scope, cell, "x").release()
    with locked(lock, fcntl.LOCK_EX), pytest.raises(DoraSystemdError) as caught:
        take_inhibiting(scope, cell, "x")
    assert caught.value.code is ExitCode.INHIBITED


def test_a_lock_follows_a_restart(scope: ScopeIn, lock: Path) -> None:
    held = Lock(lock.parent, "why")
    assert held.take()
    make_lock(lock)
    assert read_holders(scope, ["robot"]) == {}
    held.renew()
    assert [one.why for one in read_holders(scope, ["robot"])["robot"]] == ["why"]
    lock.unlink()
    held.renew()
    make_lock(lock)
    held.renew()
    held.renew()
    assert lock.read_text().count("why") == 1
    held.release()


def test_what_does_not_run_cannot_be_inhibited(scope: ScopeIn, manager: FakeManager) -> None:
    manager.add(options(), active="failed")
    (cell,) = read_cells(manager)
    with pytest.raises(DoraSystemdError, match="it is not running") as caught:
        take_inhibiting(scope, cell, "x")
    assert caught.value.code is ExitCode.NOT_RUNNING
    manager.add(options(), active="activating", SubState="auto-restart")
    (cell,) = read_cells(manager)
    with pytest.raises(DoraSystemdError, match="it waits for its restart") as caught:
        take_inhibiting(scope, cell, "x")
    assert caught.value.code is ExitCode.NOT_RUNNING


def test_a_part_cannot_be_inhibited(scope: ScopeIn, manager: FakeManager, lock: Path) -> None:
    manager.add(options(machine="gpu", head="robot-1"))
    (cell,) = read_cells(manager)
    with pytest.raises(DoraSystemdError, match="cannot inhibit robot here") as caught:
        take_inhibiting(scope, cell, "x")
    assert caught.value.hint == "on robot-1: doractl inhibit robot"
    assert not lock.read_text()
