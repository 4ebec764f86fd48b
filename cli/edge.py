"""Escapes all output of doractl, so that foreign text cannot control a terminal.

File names, lines of nodes and messages of systemd get into tables and messages in many places. One
stream for all output cannot be forgotten in any of them.
"""

import io
import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, TextIO

from dora_systemd.errors import REACHED_AS, DoraSystemdError
from dora_systemd.terminal_text import escaped, one_line

_STANDARD = ("stdin", "stdout", "stderr")
"""Streams by file descriptor."""
VERBS = (
    *("advise", "build", "bundle", "bundles", "deploy", "destroy", "disable", "doctor", "dora"),
    *("enable", "env", "export"),
    *("forget", "inhibit", "list", "logs", "machine", "member", "node", "releases", "reload"),
    *("reset", "restart", "rollback", "run", "set", "setup", "show", "start", "stop", "top"),
    *("up", "version", "why", "ps", "status", "reset-failed"),
)
"""The verbs of group.py and their aliases, whose import takes longer than most commands."""


class Edge(io.TextIOWrapper):
    """A stream that writes text as terminal_text.escaped() shows it."""

    reached_as = ""
    """The -H of the person who reads this on another host, see with_target()."""
    scope = ""
    """--system or --user, if that person has to write it, see with_target()."""

    def write(self, text: str) -> int:
        """Write `text` with control characters escaped."""
        return super().write(escaped(with_target(text, self.reached_as, self.scope)))

    def write_own(self, text: str) -> None:
        """Write `text` unchanged."""
        super().write(text)


class Messages(Edge):
    """Standard error. What it cannot write changes neither what doractl does nor its exit status.

    Its reader may be gone, its disk full.
    """

    def write(self, text: str) -> int:
        """Write `text` with control characters escaped, if possible."""
        with suppress(OSError):
            super().write(text)
        return len(text)

    def write_own(self, text: str) -> None:
        """Write `text` unchanged, if possible."""
        with suppress(OSError):
            super().write_own(text)

    def flush(self) -> None:
        """Write what is buffered, if possible."""
        with suppress(OSError):
            super().flush()


def put_in_place() -> None:
    """Replace standard output and error by escaping streams; open those that are closed."""
    _open_closed()
    # Not for the programs that doractl starts.
    Edge.reached_as, Edge.scope = os.environ.pop(REACHED_AS, ""), ""
    sys.stdout, sys.stderr = _edge(sys.stdout, Edge), _edge(sys.stderr, Messages)


def remember_scope(is_user: bool) -> None:
    """Let commands that are printed from now on have the option of the command line, if needed."""
    is_default = is_user == (os.getuid() != 0)
    Edge.scope = "" if is_default else "--user" if is_user else "--system"


def with_target(text: str, host: str, scope: str = "") -> str:
    """The text, in which commands of doractl are for that host and in that scope, if not empty."""
    if not (host or scope) or "doractl " not in text:
        return text
    verbs = "|".join(VERBS)
    scopes = "--(?:system|user)"
    # Who requested something, as in "root (doractl stop)" and "by doractl start", is no command.
    record = rf"\bby doractl |\S \(doractl (?:node )?(?:{verbs})\)"
    command = (
        rf"{record}|(\bon \S+: |\bsudo )?\bdoractl (?:({scopes}) )?({verbs})\b(?=( {scopes}\b)?)"
    )

    def there(found: re.Match[str]) -> str:
        before, given, verb, behind = found.groups("")
        if not verb:
            return found[0]
        # With sudo the scope is the system's; in "doractl list --system" it is behind the verb.
        has_scope = before == "sudo " or behind
        words = [given or ("" if has_scope else scope), verb]
        # As in "on head: doractl stop": to be typed there.
        if host and not before.startswith("on "):
            # What env prints leads to 127.0.0.1 there, so -H refuses env.
            words = [*words, "on", host] if verb == "env" else ["-H", host, *words]
        return " ".join([f"{before}doractl", *filter(None, words)])

    return re.sub(command, there, text)


def _open_closed() -> None:
    """Open /dev/null for each standard stream that is closed.

    print() writes to standard output if there is no standard error, and the next file that anything
    opens would get the number of the closed one.
    """
    if None not in (sys.stdin, sys.stdout, sys.stderr):
        return
    while (fd := os.open(os.devnull, os.O_RDWR)) < len(_STANDARD):
        os.set_inheritable(fd, True)
    os.close(fd)
    for fd, name in enumerate(_STANDARD):
        if getattr(sys, name) is None:
            stream = os.fdopen(fd, "w" if fd else "r", encoding="utf-8")
            setattr(sys, name, stream)
            setattr(sys, f"__{name}__", stream)  # else garbage, which closes its descriptor


def _edge(stream: TextIO, kind: type[Edge]) -> TextIO:
    if not isinstance(stream, io.TextIOWrapper):  # that of a test
        return stream
    # File names need not be valid in the terminal's encoding.
    return kind(
        stream.buffer,
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
    )


def write_own(stream: TextIO, text: str) -> None:
    """Write a text of our own that contains control sequences."""
    if isinstance(stream, Edge):
        stream.write_own(text)
    else:
        stream.write(text)


def write_view(stream: TextIO, text: str) -> None:
    """Write a table or a report, in which nothing but our own colours controls the terminal."""
    if isinstance(stream, Edge):
        text = with_target(text, stream.reached_as, stream.scope)
    write_own(stream, text)


def write_exactly(text: str) -> None:
    """Print text for programs: unchanged to a pipe or a file, escaped to a terminal."""
    if sys.stdout.isatty():
        sys.stdout.write(text)
    else:
        write_own(sys.stdout, text)


def asks_for_json(arguments: Sequence[str]) -> bool:
    """Whether a command line, which may be wrong, has `-o json`."""
    own = arguments[: arguments.index("--")] if "--" in arguments else arguments
    words = f" {' '.join(own)} "
    return any(f" {one}json " in words for one in ("-o ", "-o", "--output ", "--output="))


def print_error(error: DoraSystemdError, is_json: bool) -> None:
    """Print an error on standard error: a line and a hint, or a JSON object."""
    if is_json:
        # Imported late: a command that works does without it.
        from dora_systemd.decisions.views.objects import error_object

        print_object("error", error_object(error))
        return
    for line in error.lines:
        print(f"  {one_line(line)}", file=sys.stderr)
    print(f"doractl: {error.message}", file=sys.stderr)
    if error.hint:
        print(f"hint: {error.hint}", file=sys.stderr)


def print_warning(text: str, is_json: bool) -> None:
    """Print a warning on standard error: a line, or a JSON object."""
    if is_json:
        print_object("warning", {"message": text})
    else:
        print(f"doractl: {text}", file=sys.stderr)


def print_object(key: str, value: dict[str, Any]) -> None:
    """An object for programs on standard error, in one line."""
    from dora_systemd.decisions.views.objects import format_json

    print(format_json({key: value}), file=sys.stderr)
