"""D-Bus without a bus: how values are sent, and what its errors become."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dora_systemd.adapters.bus import connection
from dora_systemd.adapters.bus import errors as bus_errors
from dora_systemd.adapters.bus import systemd as bus
from dora_systemd.adapters.bus.wire import decoded, encoded
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from tests.unit.fakes.library import fake_systemd
from tests.unit.fakes.manager import FakeManager, ScopeIn

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


@pytest.mark.parametrize("text", ["a\0b", "\udcff", "\0"])
def test_what_is_no_text_for_d_bus(text: str) -> None:
    with pytest.raises(DoraSystemdError) as caught:
        encoded("s", text)
    assert caught.value.code is ExitCode.USAGE


@given(st.lists(st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))))
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


class Departing(bus.Bus):
    """Units of which some end before they can be stopped."""

    def __init__(self, code: ExitCode) -> None:
        self.code = code

    def _listen(self, unit: str) -> None:
        del unit

    def _call(self, action: str, method: str, *arguments: Any, **more: Any) -> str:
        del method, more
        unit = arguments[0][1]
        if unit == "gone":
            raise DoraSystemdError(f"cannot {action}", "", self.code)
        return f"/job/{unit}"

    def _wait_for_jobs(self, jobs: dict[str, str], observer: object) -> dict[str, str]:
        del observer
        return dict.fromkeys(jobs.values(), "failed")


def test_a_unit_that_is_gone_is_stopped() -> None:
    systemd = Departing(ExitCode.NOT_FOUND)
    assert systemd.run_jobs("StopUnit", ["gone", "other"]) == {"gone": "done", "other": "failed"}
    with pytest.raises(DoraSystemdError):
        systemd.run_jobs("RestartUnit", ["gone"])
    with pytest.raises(DoraSystemdError):
        Departing(ExitCode.NO_PERMISSION).run_jobs("StopUnit", ["gone"])


class Freezer(bus.Bus):
    """A unit in a state of its freezer; the methods that were called."""

    def __init__(self, state: str) -> None:
        self.scope = SYSTEM
        self.state = state
        self.called: list[str] = []

    def _listen(self, unit: str) -> None:
        del unit

    def _call(self, action: str, method: str, *arguments: Any, **more: Any) -> str:
        del action, more
        if method != "Get":
            self.called.append(method)
            return "/job/1"
        return self.state if arguments[1][1] == "FreezerState" else "dora.slice"


@pytest.mark.parametrize("state", ["running", "frozen"])
def test_nothing_frozen_is_stopped_or_killed(state: str) -> None:
    systemd = Freezer(state)
    thaw = ["ThawUnit"] if state == "frozen" else []
    systemd.queue_job("StopUnit", "x.service")
    systemd.queue_job("RestartUnit", "x.service")
    systemd.kill("x.service", 9)
    assert systemd.called == [*thaw, "StopUnit", *thaw, "RestartUnit", *thaw, "KillUnit"]
    systemd.queue_job("StartUnit", "x.service")
    assert systemd.called[-2:] == ["KillUnit", "StartUnit"]


def test_a_frozen_slice_is_left_to_its_owner() -> None:
    systemd = Freezer("frozen-by-parent")
    with pytest.raises(DoraSystemdError, match="slice that contains it is frozen") as caught:
        systemd.queue_job("StopUnit", "x.service")
    assert caught.value.hint == "run: systemctl --system thaw dora.slice"
    assert not systemd.called


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


@pytest.mark.parametrize("now", [0, 8])
def test_a_job_that_ends_while_it_is_asked_waits_for_nothing(now: int) -> None:
    """The error has the class of ENOENT then, and no name."""
    jobs = iter([7, now])

    class OneJob(bus.Bus):
        def _read_one(self, *_: Any) -> Any:
            return next(jobs), "/"

        def _call(self, *_: Any, **_named: Any) -> Any:
            raise DoraSystemdError("cannot read the job: Job 7 does not exist.")

        def __init__(self) -> None:
            pass

    assert OneJob().awaited("dora-robot.service") == []


class DBusBaseError(Exception):
    """The class of all errors of pystemd."""

    errno = -110


def test_a_systemd_that_accepts_and_does_not_answer_costs_no_descriptor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """pystemd closes them only on request, and the gateway tries again and again."""
    systemd = fake_systemd(monkeypatch, FakeManager())
    systemd.refuses = DBusBaseError()
    with pytest.raises(DoraSystemdError, match=r"^cannot reach systemd: Connection timed out$"):
        connection._open(SYSTEM, "/nowhere/private", 5.0, 1.0)
    assert not systemd.connections
