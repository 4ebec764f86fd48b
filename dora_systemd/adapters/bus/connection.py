"""Connects to systemd by the message bus or its private socket, with a timeout for each.

encoded() and decoded() convert values to and from the form that pystemd's call_method() uses, and
explained() turns its errors into those for users.
"""

import _thread
import os
import select
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import is_readable
from dora_systemd.scope import Scope, without_systemd
from dora_systemd.trust.paths import user_name

SERVICE = b"org.freedesktop.systemd1"
MANAGER_OBJECT = b"/org/freedesktop/systemd1"
SYSTEM_BUS = Path("/run/dbus/system_bus_socket")

READ_SECONDS = 5.0
"""Timeout for an answer on a connection that only reads."""
CALL_SECONDS = 25.0
"""Timeout for any other answer, as in systemctl: systemd may be reloading all units."""
RELOAD_SECONDS = 180.0
"""Timeout for a reload, as in systemctl: generators run, and each of them may take 90 s."""
_BUS_SECONDS = 1.0
"""Timeout for the first message from the message bus, if there is another way."""
_TIMEOUT = "SYSTEMD_BUS_TIMEOUT"
"""The only way to set the timeout of sd-bus through pystemd: read at a connection's first call."""
_FIRST_PERSON = 1000
"""Users with smaller numbers are system accounts."""
_environment = _thread.allocate_lock()  # threading takes a while to load
_CLOSE = (-1, None)
"""pystemd's mark for the end of a container."""


def connect(scope: Scope, for_reading: bool, seconds: float = 0) -> Any:
    """A pystemd connection to the manager of `scope`, with `seconds` for each answer if not 0.

    Raises DoraSystemdError (NO_SYSTEMD).
    """
    address, private = _address(scope), _private_socket(scope)
    seconds = seconds or (READ_SECONDS if for_reading else CALL_SECONDS)
    # Only root may use the system manager's private socket. It is the second choice: systemd takes
    # some milliseconds for each connection to it, and it is only on the bus that systemd notices
    # when a client disconnects, which hold() needs.
    has_other_way = address != private and Path(private).exists()
    if for_reading and has_other_way and scope.is_callers:
        with suppress(DoraSystemdError):
            return _open(scope, address, seconds, _BUS_SECONDS)
        address = private
    return _open(scope, address, seconds, READ_SECONDS)


def _open(scope: Scope, address: str, seconds: float, patience: float) -> Any:
    """A connection with `seconds` for each answer, and `patience` seconds for the first message."""
    # Imported late: commands such as --help and version work without pystemd.
    from dora_systemd.adapters.bus.library import dbuslib

    # A manager's private socket is not a bus, so there is no Hello call.
    is_private = address.endswith("/private")
    with _translated(lambda error: _unreachable(scope, error)), ExitStack() as undo:
        bus = dbuslib.DBusAddress(f"unix:path={address}".encode(), peer_to_peer=is_private)
        with _deadline(seconds):
            bus.open()  # calls Hello
        undo.callback(bus.close)
        # sd-bus itself would wait 90 s for the first message.
        poll = select.poll()
        poll.register(bus.get_fd(), select.POLLIN)
        if not poll.poll(patience * 1000):
            raise silent_bus(scope, is_private)
        if is_private:
            with _deadline(seconds):
                bus.call_method(SERVICE, MANAGER_OBJECT, b"org.freedesktop.DBus.Peer", b"Ping", [])
        undo.pop_all()
    return bus


@contextmanager
def _deadline(seconds: float) -> Iterator[None]:
    """Set the timeout for answers on the connection whose first call is made in this block."""
    with _environment:
        before = os.environ.get(_TIMEOUT)
        os.environ[_TIMEOUT] = before or f"{seconds:g}s"
        try:
            yield
        finally:
            if before is None:
                del os.environ[_TIMEOUT]


def _address(scope: Scope) -> str:
    """The message bus, else the manager's private socket, because a user may have no bus."""
    bus = scope.runtime_root / "bus" if scope.is_user else SYSTEM_BUS
    private = Path(_private_socket(scope))
    return str(private) if not bus.exists() and private.exists() else str(bus)


def _private_socket(scope: Scope) -> str:
    return str(scope.runtime_root / "systemd" / "private")


def encoded(signature: str, value: Any) -> list[tuple[int, Any]]:
    """`value` as the sequence of basic types and containers for call_method().

    A variant's value is a pair of its signature and its value.
    """
    kind = signature[0]
    if kind == "a":
        items = [word for one in value for word in encoded(signature[1:], one)]
        return [(ord("a"), signature[1:].encode()), *items, _CLOSE]
    if kind == "(":
        pairs = zip(_split(signature[1:-1]), value, strict=True)
        items = [word for inner, one in pairs for word in encoded(inner, one)]
        return [(ord("r"), signature[1:-1].encode()), *items, _CLOSE]
    if kind == "v":
        return [(ord("v"), value[0].encode()), *encoded(*value), _CLOSE]
    return [(ord(kind), _text(value) if kind in "sog" else value)]


def _text(value: str) -> bytes:
    if not is_readable(value):
        hint = "write it as UTF-8, without NUL and noncharacters"
        raise usage_error(f"cannot send {value!r} to systemd", hint)
    return value.encode()


def _split(signature: str) -> list[str]:
    """The complete types of a signature: "sasb" gives s, as, b."""
    types, current, depth = [], "", 0
    for char in signature:
        current += char
        depth += (char == "(") - (char == ")")
        if char != "a" and depth == 0:
            types.append(current)
            current = ""
    return types


def decoded(value: Any) -> Any:
    """The body of a message of pystemd, with str for bytes and lists for tuples."""
    if isinstance(value, bytes):
        return os.fsdecode(value)
    if isinstance(value, dict):
        return {decoded(key): decoded(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [decoded(one) for one in value]
    return value


_DENIED = ("permission denied", ExitCode.NO_PERMISSION)
_SILENT = ("systemd does not answer", ExitCode.NO_SYSTEMD)
_AWAY = ("systemd is not on the message bus", ExitCode.NO_SYSTEMD)
_REASONS = {
    **dict.fromkeys(("AccessDenied", "InteractiveAuthorizationRequired", "AuthFailed"), _DENIED),
    "UnitExists": ("a unit of that name already exists", ExitCode.NAME_IN_USE),
    "NoSuchUnit": ("there is no such unit", ExitCode.NOT_FOUND),
    "NoSuchJob": ("there is no such job", ExitCode.NOT_FOUND),
    "Disconnected": ("systemd hung up", ExitCode.NO_SYSTEMD),
    **dict.fromkeys(("ConnectionRefused", "NoReply", "Timeout", "TimedOut"), _SILENT),
    **dict.fromkeys(("ServiceUnknown", "NameHasNoOwner"), _AWAY),
}


def explained(action: str, scope: Scope) -> AbstractContextManager[None]:
    """Turn pystemd's errors into DoraSystemdError "cannot `action`: reason"."""
    return _translated(
        lambda error: bus_error(action, scope, error_name(error), _told(error, "err_message"))
    )


@contextmanager
def _translated(explain: Callable[[Exception], DoraSystemdError]) -> Iterator[None]:
    """Raise `explain(error)` for an error of pystemd, which is not imported here: that is slow."""
    try:
        yield
    except Exception as error:
        if not any(kind.__name__ == "DBusBaseError" for kind in type(error).__mro__):
            raise
        raise explain(error) from error


def bus_error(action: str, scope: Scope, name: str, message: str) -> DoraSystemdError:
    """The error for a D-Bus error name (its last part) and message."""
    reason, code = _REASONS.get(name, (message or name, ExitCode.FAILURE))
    hint = "" if code is ExitCode.NO_PERMISSION and scope.is_user else _HINTS.get(code, "")
    return DoraSystemdError(f"cannot {action}: {reason}", hint, code)


_HINTS = {
    ExitCode.NO_PERMISSION: "use sudo, or --user for a dataflow of your own",
    ExitCode.NOT_FOUND: "doractl list --all shows all dataflows",
    ExitCode.NAME_IN_USE: "doractl list shows it; stop it, or choose another --name",
    ExitCode.NO_SYSTEMD: "see systemctl is-system-running",
}


def _unreachable(scope: Scope, error: Exception) -> DoraSystemdError:
    manager = "the systemd of this user" if scope.is_user else "systemd"
    reason = os.strerror(-getattr(error, "errno", 0))
    message = f"cannot reach {manager}: {reason}"
    return DoraSystemdError(message, _connection_hint(scope), ExitCode.NO_SYSTEMD)


def silent_bus(scope: Scope, is_private: bool) -> DoraSystemdError:
    """The error for a manager or message bus that does not answer."""
    flag = "--user " if scope.is_user else ""
    silent, verb = (
        ("systemd", "is-system-running") if is_private else ("the message bus", "status dbus")
    )
    message = f"cannot reach systemd: {silent} does not answer"
    return DoraSystemdError(message, f"see systemctl {flag}{verb}", ExitCode.NO_SYSTEMD)


def _connection_hint(scope: Scope) -> str:
    if absent := without_systemd():
        return absent
    if not scope.is_user:
        return "see systemctl is-system-running"
    user = user_name(scope.uid, nameless="")
    if 0 < scope.uid < _FIRST_PERSON:
        # Since systemd 258 no login of such an account starts one.
        remedy = f"as root: loginctl enable-linger {user}"
        return f"{user} is a system account, which needs a manager, {remedy}"
    return f"log in as {user}, or let the manager run without: loginctl enable-linger {user}"


def error_name(error: Exception) -> str:
    """The last part of the D-Bus error name; pystemd has a class for each name that it knows."""
    own = type(error).__name__.removeprefix("DBus").removesuffix("Error")
    return _told(error, "err_name").rpartition(".")[2] or own


def _told(error: Exception, name: str) -> str:
    text = getattr(error, name, "")
    return text.decode(errors="replace") if isinstance(text, bytes) else str(text)
