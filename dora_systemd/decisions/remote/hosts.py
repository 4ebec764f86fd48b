"""Hosts on a command line and in a hosts file. Pure."""

import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted

ALL = "all"
"""As a host: all hosts of the hosts file."""

_ADDRESS = r"[0-9A-Fa-f.]*(?::[0-9A-Fa-f.]*){2,}(?:%[A-Za-z0-9_.-]+)?"
# No host or user begins with a dash: ssh would take it for an option.
_HOST = re.compile(
    r"(?P<user>[A-Za-z0-9_][A-Za-z0-9_.+-]*@)?"
    rf"(?:(?P<address>{_ADDRESS})"
    r"|(?:(?P<name>[A-Za-z0-9_][A-Za-z0-9_.-]*)"
    rf"|\[(?P<inner>{_ADDRESS})\])(?::(?P<port>[0-9]{{1,5}}))?)"
)
_MAX_LENGTH = 255
_MAX_PORT = 65535


class Host(NamedTuple):
    """A host. text: as the user wrote it. destination, port: for ssh(1); port may be "".

    Without a destination it is this machine.
    """

    text: str
    destination: str
    port: str = ""


def parse_host(text: str) -> Host:
    """`[user@]HOST[:PORT]`; an IPv6 address with a port is in brackets.

    Raises DoraSystemdError (USAGE).
    """
    match = _HOST.fullmatch(text) if len(text) <= _MAX_LENGTH else None
    port = (match and match["port"]) or ""
    if match is None or (port and not 0 < int(port) <= _MAX_PORT):
        hint = "[user@]HOST[:PORT], several with commas, or all"
        raise DoraSystemdError(f"cannot use {quoted(text)} as a host", hint, ExitCode.USAGE)
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
                hint = "write a host in each line"
                what = f"cannot read {path}: line {number}: {ALL} stands for the hosts of this file"
                raise DoraSystemdError(what, hint, ExitCode.BAD_INPUT)
            try:
                yield parse_host(word)
            except DoraSystemdError as error:
                what = f"cannot read {path}: line {number}: {error.message}"
                hint = "write one [user@]HOST[:PORT] in each line"
                raise DoraSystemdError(what, hint, ExitCode.BAD_INPUT) from error
