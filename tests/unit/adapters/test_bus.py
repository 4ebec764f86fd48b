"""D-Bus without a bus: how values are sent, and what its errors become."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.bus import connection
from dora_systemd.adapters.bus import connection as bus_errors
from dora_systemd.adapters.bus import systemd as bus
from dora_systemd.adapters.bus.connection import decoded, encoded
from dora_systemd.adapters.bus.manager import Observer
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import is_readable
from dora_systemd.scope import Scope
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import FakeManager, ScopeIn, options

SYSTEM = Scope(is_user=False, uid=0)
USER = Scope(is_user=True, uid=1000)
CLOSE = (-1, None)


def test_basic_types() -> None:
    assert encoded("s", "ä") == [(ord("s"), "ä".encode())]
    assert encoded("b", True) == [(ord("b"), True)]
    assert encoded("t", 2**64 - 1) == [(ord("t"), 2**64 - 1)]


def test_containers() -> None:
    assert encoded("a(sasb)", [("/bin/x", ["x", "y"], False)]) == [
        (ord("a"), b"(sasb)"),
        (ord("r"), b"sasb"),
        (ord("s"), b"/bin/x"),
        (ord("a"), b"s"),
        (ord("s"), b"x"),
        (ord("s"), b"y"),
        CLOSE,
        (ord("b"), False),
        CLOSE,
        CLOSE,
    ]


def test_variant() -> None:
    assert encoded("v", ("as", [])) == [(ord("v"), b"as"), (ord("a"), b"s"), CLOSE, CLOSE]


def test_nested_structs() -> None:
    assert encoded("(i(ss)a(st))", (1, ("a", "b"), [])) == [
        (ord("r"), b"i(ss)a(st)"),
        (ord("i"), 1),
        (ord("r"), b"ss"),
        (ord("s"), b"a"),
        (ord("s"), b"b"),
        CLOSE,
        (ord("a"), b"(st)"),
        CLOSE,
        CLOSE,
    ]


def test_a_struct_of_the_wrong_length_is_a_mistake_of_ours() -> None:
    with pytest.raises(ValueError, match="zip"):
        encoded("(ss)", ("a",))


@pytest.mark.parametrize("text", ["a\0b", "\udcff", "\0", "\ufdd0", "\uffff"])
def test_what_is_no_text_for_d_bus(text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        encoded("s", text)
    assert caught.value.code is ExitCode.USAGE


@given(st.lists(st.text().filter(is_readable)))
def test_text_survives_the_way_there_and_back(texts: list[str]) -> None:
    sent = [value for kind, value in encoded("as", texts) if kind == ord("s")]
    assert decoded(sent) == texts


def test_answers_are_decoded_at_every_depth() -> None:
    assert decoded([(b"a", 1, {b"k": [b"v"]}), True]) == [["a", 1, {"k": ["v"]}], True]


def test_object_paths() -> None:
    path = bus._unit_path("dora-a_b.c.service")
    assert path == b"/org/freedesktop/systemd1/unit/dora_2da_5fb_2ec_2eservice"


@pytest.mark.parametrize(
    ("name", "scope", "code", "words"),
    [
        ("AccessDenied", SYSTEM, ExitCode.NO_PERMISSION, "permission denied"),
        ("InteractiveAuthorizationRequired", SYSTEM, ExitCode.NO_PERMISSION, "permission denied"),
        ("UnitExists", USER, ExitCode.NAME_IN_USE, "already exists"),
        ("NoSuchUnit", USER, ExitCode.NOT_FOUND, "no such unit"),
        ("NoReply", USER, ExitCode.NO_SYSTEMD, "does not answer"),
        ("InvalidArgs", USER, ExitCode.FAILURE, "its own words"),
    ],
)
def test_errors(name: str, scope: Scope, code: ExitCode, words: str) -> None:
    error = bus_errors.bus_error("start dora-x.service", scope, name, "its own words")
    assert error.message.startswith("cannot start dora-x.service: ")
    assert words in error.message
    assert error.code is code


def test_sudo_is_no_hint_for_a_user_manager() -> None:
    assert "sudo" in bus_errors.bus_error("x", SYSTEM, "AccessDenied", "").hint
    assert "sudo" not in bus_errors.bus_error("x", USER, "AccessDenied", "").hint


def test_names_of_pystemds_errors() -> None:
    class DBusBaseError(Exception):
        err_name: bytes | str = b"org.freedesktop.systemd1.UnitExists"
        err_message = b"told so"

    class DBusAccessDeniedError(DBusBaseError):
        err_name = ""

    assert bus_errors.error_name(DBusBaseError()) == "UnitExists"
    assert bus_errors.error_name(DBusAccessDeniedError()) == "AccessDenied"
    with (
        pytest.raises(DoraSystemdError, match="cannot do it: a unit"),
        bus_errors.explained("do it", SYSTEM),
    ):
        raise DBusBaseError


class DBusBaseError(Exception):
    """The class of all errors of pystemd."""

    errno = -110
    err_name = ""

    def __init__(self, name: str = "", message: str = "") -> None:
        super().__init__(name, message)
        self.err_name, self.err_message = name, message


class Departing(FakeManager):
    """A manager about whose unit "gone" systemd says `error`: it ends before it can be stopped."""

    def __init__(self, error: str) -> None:
        super().__init__()
        self.error = DBusBaseError(f"org.freedesktop.systemd1.{error}")
        self.units["other"] = {}
        self.job_results["other"] = "failed"

    def run_jobs(
        self, method: str, units: Sequence[str], observer: Observer | None = None
    ) -> dict[str, str]:
        if "gone" in units:
            raise self.error
        return super().run_jobs(method, units, observer)


def test_a_unit_that_is_gone_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_systemd(monkeypatch, Departing("NoSuchUnit"))
    systemd = bus.Bus(SYSTEM)
    assert systemd.run_jobs("StopUnit", ["gone", "other"]) == {"gone": "done", "other": "failed"}
    with pytest.raises(DoraSystemdError, match="there is no such unit"):
        systemd.run_jobs("RestartUnit", ["gone"])
    fake_systemd(monkeypatch, Departing("AccessDenied"))
    with pytest.raises(DoraSystemdError, match="permission denied"):
        bus.Bus(SYSTEM).run_jobs("StopUnit", ["gone"])


def test_a_refused_hold_is_a_refused_start(monkeypatch: pytest.MonkeyPatch) -> None:
    systemd = fake_systemd(monkeypatch, FakeManager())
    systemd.refused["RefUnit"] = DBusBaseError("org.freedesktop.systemd1.AccessDenied")
    with pytest.raises(DoraSystemdError) as caught:
        bus.Bus(SYSTEM).hold("dora-robot.service")
    assert caught.value.message == "cannot start dora-robot.service: permission denied"


@pytest.mark.parametrize("state", ["running", "frozen"])
def test_nothing_frozen_is_stopped_or_killed(state: str, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = FakeManager()
    unit = manager.add(options())
    fake_systemd(monkeypatch, manager)
    systemd = bus.Bus(SYSTEM)

    def calls_of(act: Callable[[], object]) -> list[str]:
        manager.units[unit]["FreezerState"] = state
        manager.calls.clear()
        act()
        return [call[0] for call in manager.calls]

    thaw = ["thaw"] if state == "frozen" else []
    assert calls_of(lambda: systemd.queue_job("StopUnit", unit)) == [*thaw, "StopUnit"]
    assert calls_of(lambda: systemd.queue_job("RestartUnit", unit)) == [*thaw, "RestartUnit"]
    assert calls_of(lambda: systemd.kill(unit, 9)) == [*thaw, "kill"]
    assert calls_of(lambda: systemd.queue_job("StartUnit", unit)) == ["StartUnit"]


def test_a_frozen_slice_is_left_to_its_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    manager = FakeManager()
    unit = manager.add(options(), FreezerState="frozen-by-parent", Slice="dora.slice")
    fake_systemd(monkeypatch, manager)
    with pytest.raises(DoraSystemdError, match="slice that contains it is frozen") as caught:
        bus.Bus(SYSTEM).queue_job("StopUnit", unit)
    assert caught.value.hint == "run: systemctl --system thaw dora.slice"
    assert not manager.calls


def test_other_errors_pass() -> None:
    with pytest.raises(ZeroDivisionError), bus_errors.explained("do it", SYSTEM):
        raise ZeroDivisionError


def test_private_socket_where_a_user_has_no_bus(tmp_path: Path) -> None:
    scope = ScopeIn(is_user=True, uid=1000, root=tmp_path)
    assert connection._address(scope) == str(tmp_path / "bus")
    (tmp_path / "systemd").mkdir()
    (tmp_path / "systemd" / "private").touch()
    assert connection._address(scope) == str(tmp_path / "systemd" / "private")
    (tmp_path / "bus").touch()
    assert connection._address(scope) == str(tmp_path / "bus")


class Working(FakeManager):
    """A manager that has another job for its unit each time that it is asked."""

    def __init__(self, *jobs: int) -> None:
        super().__init__()
        self.jobs = list(jobs)

    def read(self, unit: str, names: Sequence[str]) -> dict[str, Any]:
        return {**super().read(unit, names), "Job": [self.jobs.pop(0), "/"]}


@pytest.mark.parametrize("now", [0, 8])
def test_a_job_that_ends_while_it_is_asked_waits_for_nothing(
    now: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error has the class of ENOENT then, and no name."""
    manager = Working(7, now)
    systemd = fake_systemd(monkeypatch, manager)
    systemd.refused["GetJobBefore"] = DBusBaseError(message="Job 7 does not exist.")
    assert bus.Bus(SYSTEM).awaited("dora-robot.service") == []
    assert not manager.jobs


def test_a_job_that_systemd_tells_nothing_of(monkeypatch: pytest.MonkeyPatch) -> None:
    systemd = fake_systemd(monkeypatch, Working(7, 7))
    systemd.refused["GetJobBefore"] = DBusBaseError(message="Job 7 does not exist.")
    with pytest.raises(DoraSystemdError, match=r"read the job of dora-robot\.service: Job 7"):
        bus.Bus(SYSTEM).awaited("dora-robot.service")


def test_a_systemd_that_accepts_and_does_not_answer_costs_no_descriptor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """pystemd closes them only on request, and the gateway tries again and again."""
    systemd = fake_systemd(monkeypatch, FakeManager())
    systemd.refuses = DBusBaseError()
    with pytest.raises(DoraSystemdError, match=r"^cannot reach systemd: Connection timed out$"):
        connection._open(SYSTEM, "/nowhere/private", 5.0, 1.0)
    assert not systemd.connections


def test_a_reload_may_take_as_long_as_generators(monkeypatch: pytest.MonkeyPatch) -> None:
    systemd = fake_systemd(monkeypatch, manager := FakeManager())
    bus.Bus(SYSTEM).reload()
    assert systemd.timeouts == ["25s", "180s"]
    assert [call[0] for call in manager.calls] == ["reload"]
