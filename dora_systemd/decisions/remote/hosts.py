"""Hosts on a command line and in a hosts file, and the command of ssh(1) for one of them. Pure.

The login shell of the other account reads the command, whichever it is. So it gets quoted words
only, and runs sh(1) with a fixed script that gets the words of doractl as its arguments.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from typing import NamedTuple

from dora_systemd.errors import REACHED_AS, DoraSystemdError, bad_input, usage_error
from dora_systemd.values import quoted

ALL = "all"
"""The value of -H for all hosts of the hosts file."""

_ADDRESS = r"[0-9A-Fa-f.]*(?::[0-9A-Fa-f.]*){2,}(?:%[A-Za-z0-9_.-]+)?"
# No host or user begins with a dash: ssh would take it for an option.
_HOST = (
    r"(?P<user>[A-Za-z0-9_][A-Za-z0-9_.+-]*@)?"
    rf"(?:(?P<address>{_ADDRESS})"
    r"|(?:(?P<name>[A-Za-z0-9_][A-Za-z0-9_.-]*)"
    rf"|\[(?P<inner>{_ADDRESS})\])(?::(?P<port>[0-9]{{1,5}}))?)"
)
_MAX_LENGTH = 255
_MAX_PORT = 65535


class Host(NamedTuple):
    """A host.

    Without a destination it is this machine.
    """

    text: str  # as the user wrote it
    # destination, port: for ssh(1); port may be ""
    destination: str
    port: str = ""


def parse_host(text: str) -> Host:
    """`[user@]HOST[:PORT]`; an IPv6 address with a port is in brackets.

    Raises DoraSystemdError (USAGE).
    """
    match = re.fullmatch(_HOST, text) if len(text) <= _MAX_LENGTH else None
    port = (match and match["port"]) or ""
    if match is None or (port and not 0 < int(port) <= _MAX_PORT):
        hint = "[user@]HOST[:PORT], several with commas, or all"
        raise usage_error(f"cannot use {quoted(text)} as a host", hint)
    name = match["address"] or match["inner"] or match["name"]
    return Host(text, f"{match['user'] or ''}{name}", port)


def given_words(texts: Iterable[str]) -> list[str]:
    """The hosts of all -H options, each once, in their order. Raises DoraSystemdError (USAGE)."""
    words = list(dict.fromkeys(word.strip() for text in texts for word in text.split(",")))
    for word in words:
        parse_host(word)
    return words


def parse_hosts_file(text: str, path: str) -> list[Host]:
    """The hosts of a hosts file: one in a line; # begins a comment.

    Raises DoraSystemdError (BAD_INPUT) that names the line.
    """
    return list(dict.fromkeys(_lines(text, path)))


def _lines(text: str, path: str) -> Iterator[Host]:
    for number, line in enumerate(text.splitlines(), 1):
        if word := line.partition("#")[0].strip():
            if word == ALL:
                what = f"cannot read {path}: line {number}: {ALL} stands for the hosts of this file"
                raise bad_input(what, "write a host in each line")
            try:
                yield parse_host(word)
            except DoraSystemdError as error:
                what = f"cannot read {path}: line {number}: {error.message}"
                raise bad_input(what, "write one [user@]HOST[:PORT] in each line") from error


CONNECT_SECONDS = 5
"""Timeout of the connection, until a server answers."""
ALIVE_SECONDS, ALIVE_COUNT = 5, 3
"""A connection without an answer for this long, so many times, is lost."""

NO_PROGRAM = 127
"""The exit status of sh(1) where there is no doractl."""

_OPTIONS = {
    "ConnectTimeout": CONNECT_SECONDS,
    "ServerAliveInterval": ALIVE_SECONDS,
    "ServerAliveCountMax": ALIVE_COUNT,
    # No banner, no "Connection closed.": only ssh's errors.
    "LogLevel": "ERROR",
    # For a host that is configured for something else as well.
    "ClearAllForwardings": "yes",
    "RemoteCommand": "none",
}
_FIND = "command -v doractl >/dev/null 2>&1 || exit 127\n"
# A login shell may print before: what counts begins after the mark, on both streams.
_BEGIN = f'echo "$1"\necho "$1" >&2\nshift\n{_FIND}'
# Standard input ends with this doractl, and then the doractl on the host ends, too.
_FOLLOW = """exec 3<&0
doractl "$@" </dev/null 3<&- &
child=$!
(while read -r line; do :; done; kill -TERM "$child") <&3 >/dev/null 2>&1 &
watch=$!
exec 3<&- 2>/dev/null
wait "$child"
status=$?
kill "$watch" 2>/dev/null
exit "$status"
"""


class Way(Enum):
    """How doractl runs on a host: the script of sh(1).

    TERMINAL: on a terminal of its own. ONCE: until it ends by itself, without input. FED: reading
    our standard input. FOLLOWING: until this command ends.
    """

    TERMINAL = f'{_FIND}exec doractl "$@"\n'
    ONCE = f'{_BEGIN}exec doractl "$@" </dev/null\n'
    FED = f'{_BEGIN}exec doractl "$@"\n'
    FOLLOWING = f"{_BEGIN}{_FOLLOW}"


def quote(word: str) -> str:
    r"""A word for any login shell: sh, csh and fish differ about \ and ! in quotes, not outside."""
    inner = re.sub(r"[\\'!]", lambda match: f"'\\{match[0]}'", word)
    return f"'{inner}'"


def remote_command(way: Way, words: Sequence[str], mark: str = "", host: Host | None = None) -> str:
    """Return what the login shell of the host runs. mark: printed first, if not TERMINAL.

    host: as which a person has named it, for whom hints are then.
    """
    first = [] if way is Way.TERMINAL else [mark]
    named = f"export {REACHED_AS}={quote(host.text)}\n" if host and host.destination else ""
    script = _one_line(f"{named}{way.value}")
    return " ".join(["exec", "sh", "-c", *map(quote, (script, "doractl", *first, *words))])


def _one_line(script: str) -> str:
    """csh takes no newline within quotes."""
    return re.sub(r"(?<! &)\n", "; ", script.strip("\n")).replace(" &\n", " & ")


def ssh_arguments(host: Host, way: Way, command: str) -> list[str]:
    """Return the arguments of ssh(1), which on a terminal may prompt for a password or a key."""
    is_terminal = way is Way.TERMINAL
    options = {**_OPTIONS, **({} if is_terminal else {"BatchMode": "yes"})}
    words = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
    port = ["-p", host.port] if host.port else []
    return ["-t" if is_terminal else "-T", *words, *port, "--", host.destination, command]
