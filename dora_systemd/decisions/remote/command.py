"""The command line of ssh(1) that runs doractl on a host. Pure.

The login shell of the other account reads the command, whichever it is. So it gets quoted words
only, and runs sh(1) with a fixed script that gets the words of doractl as its arguments.
"""

import re
from collections.abc import Sequence
from enum import Enum

from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.errors import REACHED_AS

CONNECT_SECONDS = 5
"""For the connection, until ssh knows that a server speaks there."""
ALIVE_SECONDS, ALIVE_COUNT = 5, 3
"""A connection without an answer for this long, so many times, is lost."""

NO_PROGRAM = 127
"""The exit status of sh(1) where there is no doractl."""

_OPTIONS = {
    "ConnectTimeout": CONNECT_SECONDS,
    "ServerAliveInterval": ALIVE_SECONDS,
    "ServerAliveCountMax": ALIVE_COUNT,
    # No banner, no "Connection closed.": what is left are ssh's errors.
    "LogLevel": "ERROR",
    # For a host that is configured for something else as well.
    "ClearAllForwardings": "yes",
    "RemoteCommand": "none",
}
_FIND = "command -v doractl >/dev/null 2>&1 || exit 127\n"
# A login shell may print before: what counts begins after the mark, on both streams.
_BEGIN = f'echo "$1"\necho "$1" >&2\nshift\n{_FIND}'
# Standard input is the life line: it ends with this doractl, and so does the one over there.
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
    """How doractl runs over there: the script of sh(1).

    TERMINAL: on a terminal of its own. ONCE: it ends by itself, without input. FED: it reads our
    standard input. FOLLOWING: it ends with this command.
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
    """What the login shell of the host runs. mark: printed first, if not TERMINAL.

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
    """The arguments of ssh(1). On a terminal it may ask for a password or about a host key."""
    is_terminal = way is Way.TERMINAL
    options = {**_OPTIONS, **({} if is_terminal else {"BatchMode": "yes"})}
    words = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
    port = ["-p", host.port] if host.port else []
    return ["-t" if is_terminal else "-T", *words, *port, "--", host.destination, command]
