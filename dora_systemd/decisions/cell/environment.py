"""Environment variables of a dataflow: parses `KEY=VALUE` from flags and files, and checks them."""

import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePath

from dora_systemd.decisions.cell.options import (
    RunnerOptions,
    SettingText,
    changed,
    format_setting,
    parse_setting,
)
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.names import is_readable
from dora_systemd.paths import CellPaths, own_directory
from dora_systemd.values import quoted

MAX_ENTRY = 128 * 1024 - 1
"""Maximum bytes of one `KEY=VALUE`: execve(2) refuses a longer one (MAX_ARG_STRLEN) with its NUL.
"""

_KEY = r"[A-Za-z_][A-Za-z0-9_]*"
_CONTROL = r"[\x00-\x08\x0a-\x1f\x7f]"
LOCK_VARIABLE = "DORA_INHIBIT_LOCK"
"""Variable of the nodes with the path of the file that they lock to inhibit restarts."""
SET_VARIABLE = "DORA_SYSTEMD_SET"
"""Passes settings that `doractl set` has changed to the next runner, as words."""
MANAGER_VARIABLES = frozenset(
    {
        *("NOTIFY_SOCKET", "JOURNAL_STREAM", "INVOCATION_ID", "SYSTEMD_EXEC_PID", "MAINPID"),
        *("MANAGERPID", "MANAGERPIDFDID", "WATCHDOG_PID", "WATCHDOG_USEC", "RUNTIME_DIRECTORY"),
        *("LISTEN_FDS", "LISTEN_FDNAMES", "LISTEN_PID", "LISTEN_PIDFDID", "FDSTORE"),
        *("MEMORY_PRESSURE_WATCH", "MEMORY_PRESSURE_WRITE"),
        SET_VARIABLE,
        LOCK_VARIABLE,
    }
)
"""Variables that systemd sets for the runner only, see systemd.exec(5). A node that uses sd_notify
must not send messages for the cell. Environment= would also override the manager's own values: with
a NOTIFY_SOCKET from a flag the start job would wait forever."""

_RESERVED = MANAGER_VARIABLES | {"CREDENTIALS_DIRECTORY"}
"""Variables that only systemd sets; nodes get the last one, to find their credentials."""


def node_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The runner's environment without the variables that systemd sets, with the lock file."""
    kept = {key: text for key, text in environment.items() if key not in MANAGER_VARIABLES}
    directory = own_directory(environment)
    return {**kept, LOCK_VARIABLE: str(CellPaths(Path(directory)).lock)} if directory else kept


def with_place(environment: Mapping[str, str], directory: str, home: str) -> dict[str, str]:
    """The environment of nodes, with what it has at a prompt and systemd does not always set.

    directory: where the nodes run, for PWD. home: of their user, which systemd leaves out if it is
    /. Values that the environment has are kept.
    """
    return {"PWD": directory, **({"HOME": home} if home else {}), **environment}


def with_changes(options: RunnerOptions, environment: Mapping[str, str]) -> RunnerOptions:
    """The options, with the changes that `doractl set` has made since the unit was created.

    Raises DoraSystemdError for variables that `doractl set` cannot have written.
    """
    return options._replace(settings=changed(options.settings, changes_of(environment)))


def changes_of(environment: Mapping[str, str]) -> tuple[SettingText, ...]:
    """The settings that `doractl set` has changed. Raises DoraSystemdError."""
    try:
        texts = shlex.split(environment.get(SET_VARIABLE, ""))
    except ValueError as error:
        raise DoraSystemdError(f"cannot read {SET_VARIABLE}: {error}") from error
    return tuple(map(parse_setting, texts))


def changes_entry(changes: Iterable[SettingText]) -> str:
    """The variable for changes_of(), as KEY=VALUE."""
    return f"{SET_VARIABLE}={shlex.join(map(format_setting, changes))}"


def parse_assignment(text: str) -> tuple[str, str]:
    """Parse key and value of `KEY=VALUE` as `--env` takes it.

    Raises DoraSystemdError (USAGE) without "=", for a key or value that systemd refuses in
    Environment= of systemd.exec(5), for control characters and for keys that are systemd's.
    """
    key, equals, value = text.partition("=")
    if not equals:
        hint = "write KEY=VALUE, such as MODEL=yolov8n.pt"
        raise usage_error(f"cannot set environment {quoted(text)}", hint)
    return checked_variable(key, value)


def checked_variable(key: str, value: str) -> tuple[str, str]:
    """Return `key` and `value`, or raise as parse_assignment does. No error shows the value."""
    if not re.fullmatch(_KEY, key):
        raise _refusal(key, "a name is letters, digits and '_', and begins with no digit")
    if key in _RESERVED:
        raise _refusal(key, "systemd sets this one itself")
    if re.search(_CONTROL, value) or not is_readable(value):
        raise _refusal(key, "a value is one line of text without control characters")
    if len(f"{key}={value}".encode()) > MAX_ENTRY:
        raise _refusal(key, "a value has at most 128 KiB: put it in a file and give its path")
    return key, value


def unit_environment(
    search_path: str, venv: str | None, variables: Mapping[str, str]
) -> dict[str, str]:
    """The environment of a unit: PATH with the virtual environment first, and `variables`.

    PATH is that of the caller without relative entries, which would mean other directories.
    `variables` take precedence.
    """
    entries = [entry for entry in search_path.split(":") if _is_usable(entry)]
    if venv is None:
        return {"PATH": ":".join(entries), **variables}
    path = ":".join([f"{venv}/bin", *entries])
    return {"PATH": path, "VIRTUAL_ENV": venv, **variables}


def find_python(venv: str | None, search_path: str, exists: Callable[[str], bool]) -> str:
    """The interpreter of the nodes, as dora finds it: that of `venv`, else the first on PATH."""
    if venv is not None:
        return str(PurePath(venv, "bin", "python"))
    places = [place for place in search_path.split(":") if place]
    found = (str(PurePath(p, name)) for name in ("python", "python3") for p in places)
    return next(filter(exists, found), "python3")


def environment_entries(variables: Mapping[str, str]) -> tuple[str, ...]:
    """The variables as Environment= on D-Bus: a "KEY=VALUE" each."""
    return tuple(f"{key}={value}" for key, value in variables.items())


def _is_usable(entry: str) -> bool:
    return entry.startswith("/") and not re.search(_CONTROL, entry) and is_readable(entry)


def _refusal(key: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot set environment variable {quoted(key)}", hint)
