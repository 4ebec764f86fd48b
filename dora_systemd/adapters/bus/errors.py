"""Turns D-Bus errors into errors for users."""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import user_name

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
        lambda error: bus_error(action, scope, error_name(error), _text(error, "err_message"))
    )


def connection_error(scope: Scope) -> AbstractContextManager[None]:
    """Explain why a manager cannot be reached at all, with a hint."""
    return _translated(lambda error: _unreachable(scope, error))


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
    if not Path("/run/systemd/system").is_dir():
        return "this machine was not booted with systemd"
    if not scope.is_user:
        return "see systemctl is-system-running"
    user = user_name(scope.uid, nameless="")
    return f"log in as {user}, or let the manager run without: loginctl enable-linger {user}"


def error_name(error: Exception) -> str:
    """The last part of the D-Bus error name; pystemd has a class for each name that it knows."""
    own = type(error).__name__.removeprefix("DBus").removesuffix("Error")
    return _text(error, "err_name").rpartition(".")[2] or own


def _text(error: Exception, name: str) -> str:
    text = getattr(error, name, "")
    return text.decode(errors="replace") if isinstance(text, bytes) else str(text)
