"""What a member refuses before it runs anything."""

import socket
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest

from dora_systemd.decisions.cell.machines import Placed
from dora_systemd.decisions.machines.wire import Part
from dora_systemd.decisions.settings.resolve import resolve_settings
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import INFINITY, SECOND
from dora_systemd.verbs.machines import member
from dora_systemd.verbs.machines.member import MemberRequest, is_passing, start_member
from dora_systemd.verbs.start.plan import Plan
from dora_systemd.verbs.start.request import StartRequest
from tests.unit.fakes.manager import UUID, FakeManager, ScopeIn, options

OTHER = UUID.replace("5", "6")
PART = Part("robot", UUID, "gpu", "s3cret", 61001, 61003, "0" * 64, 5, "0.1.0", "1.1.0")
START = StartRequest(
    "/srv/robot.yml",
    "robot",
    uuid=UUID,
    machine="gpu",
    placed=(Placed("yolo", "gpu"),),
)


class FakeHead:
    """A head that has said what to run."""

    def __init__(self, part: Part) -> None:
        self._part = part

    def part(self) -> Part:
        return self._part

    def say(self, line: bytes) -> None:
        raise AssertionError(line)


def refused(
    manager: FakeManager, tmp_path: Path, part: Part = PART, **seconds: float
) -> DoraSystemdError:
    request = MemberRequest(ScopeIn(False, 0, tmp_path), START, **seconds)
    with pytest.raises(DoraSystemdError) as caught:
        start_member(manager, request, FakeHead(part))
    assert not [call for call in manager.calls if call[0] == "start"]
    return caught.value


@pytest.mark.parametrize("change", [{"name": "other"}, {"uuid": OTHER}, {"machine": "arm"}])
def test_a_runner_that_wants_something_else(change: dict[str, Any], tmp_path: Path) -> None:
    """The words of the command line are those of root; the runner's are not."""
    error = refused(FakeManager(), tmp_path, replace(PART, **change))
    assert error.code is ExitCode.BAD_INPUT
    assert not is_passing(error)


def test_an_sshd_that_opens_forwards_to_the_network(tmp_path: Path) -> None:
    """Any other address than 127.0.0.1 is one too many."""
    with socket.create_server(("127.0.0.2", 0)) as one:
        part = replace(PART, coordinator=one.getsockname()[1])
        error = refused(FakeManager(), tmp_path, part)
    assert "GatewayPorts" in error.hint
    assert not is_passing(error)


def test_an_address_that_this_machine_does_not_have(tmp_path: Path) -> None:
    """At a restart another attempt may help: its network may come up late."""
    start = START._replace(addresses=("192.0.2.1", "127.0.0.1"))
    request = MemberRequest(ScopeIn(False, 0, tmp_path), start, address_seconds=0.0)
    for again in (0, 1):
        part = replace(PART, again=again)
        with pytest.raises(DoraSystemdError, match="no address") as caught:
            start_member(FakeManager(), request, FakeHead(part))
        assert is_passing(caught.value) == bool(again)
    own = replace(request, start=START._replace(addresses=("127.0.0.1", "192.0.2.1")))
    with pytest.raises(DoraSystemdError, match=START.dataflow):
        start_member(FakeManager(), own, FakeHead(PART))


def test_a_runner_that_never_ends_its_line() -> None:
    runner, own = socket.socketpair()
    is_over = Event()

    def dribble() -> None:
        with suppress(OSError):
            while not is_over.wait(0.01):
                runner.sendall(b"x")

    talk = Thread(target=dribble)
    talk.start()
    waiting = Thread(target=member._first_line, args=(own, 0.3), daemon=True)
    waiting.start()
    waiting.join(10)
    is_stuck = waiting.is_alive()
    is_over.set()
    own.shutdown(socket.SHUT_RDWR)
    for one in (talk, waiting):
        one.join()
    runner.close()
    own.close()
    assert not is_stuck


def test_a_name_in_use(tmp_path: Path) -> None:
    manager = FakeManager()
    manager.add(options(uuid=OTHER))
    error = refused(manager, tmp_path)
    assert error.code is ExitCode.NAME_IN_USE
    assert OTHER in error.message


def test_a_runner_can_only_shorten_the_grace(tmp_path: Path) -> None:
    own = options()._replace(grace=5 * SECOND)
    plan = Plan(ScopeIn(False, 0, tmp_path), own, resolve_settings({}, {}, []), None, {})
    for said, taken in ((2 * SECOND, 2 * SECOND), (3600 * SECOND, 5 * SECOND), (2**63, 5 * SECOND)):
        found = member._member_plan(plan, replace(PART, grace=said)).options
        assert (found.grace, found.start_timeout) == (taken, INFINITY)


def test_an_old_part_ends_first(tmp_path: Path) -> None:
    """Also if what comes then is refused: there is no such file."""
    manager = FakeManager()
    unit = manager.add(options(placed=START.placed, machine="gpu"))
    manager.after_job[unit] = {"ActiveState": "inactive", "LoadState": "not-found"}
    assert START.dataflow in refused(manager, tmp_path).message
    assert ("StopUnit", unit) in manager.calls


@pytest.fixture
def dying(monkeypatch: pytest.MonkeyPatch) -> FakeManager:
    """A part of a former start, which is down after three looks."""
    manager = FakeManager()
    unit = manager.add(options(uuid=OTHER, placed=START.placed, machine="gpu"), "deactivating")
    looks = iter(range(3, 0, -1))

    def sleep(_seconds: float) -> None:
        if not next(looks, 0):
            manager.units[unit].update(ActiveState="inactive", LoadState="not-found")

    monkeypatch.setattr("time.sleep", sleep)
    return manager


def test_a_part_of_a_former_start_that_ends_is_awaited(dying: FakeManager, tmp_path: Path) -> None:
    """Its head is gone, and the name is about to be free."""
    assert START.dataflow in refused(dying, tmp_path).message
    assert not dying.calls, "it ends by itself"


def test_a_part_that_does_not_end_may_do_so_later(dying: FakeManager, tmp_path: Path) -> None:
    error = refused(dying, tmp_path, end_seconds=0.0)
    assert "still being stopped" in error.message
    assert is_passing(error)


def test_another_dataflow_that_ends_is_not_awaited(tmp_path: Path) -> None:
    manager = FakeManager()
    manager.add(options(uuid=OTHER), "deactivating")
    assert refused(manager, tmp_path).code is ExitCode.NAME_IN_USE


def test_what_may_pass() -> None:
    assert is_passing(DoraSystemdError("systemd boots", "", ExitCode.NO_SYSTEMD))
    assert not is_passing(DoraSystemdError("another file", "", ExitCode.BAD_INPUT))
