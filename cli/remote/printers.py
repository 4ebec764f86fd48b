"""Prints what several hosts say, each line or object with its host."""

import sys
from collections.abc import Sequence
from typing import Protocol

import click

from dora_systemd.cli.edge import print_error
from dora_systemd.decisions.remote.failures import invalid, too_much
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.remote.stream import Lines, objects_of, read_object, with_host
from dora_systemd.decisions.views.objects import error_object, format_json
from dora_systemd.errors import DoraSystemdError
from dora_systemd.terminal_text import one_line

MOST_BYTES = 64 << 20
"""Of the answer of one host that is printed as a whole."""


class Printer(Protocol):
    """Takes the output of hosts."""

    def said(self, host: Host, data: bytes) -> DoraSystemdError | None:
        """Take what was written; the error of a host that goes too far."""

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """Take the end of a host; the error of a host whose answer is not valid."""

    def finish(self) -> None:
        """Print what waits for the end of all."""


class LinePrinter:
    """Each line at once, behind its host; or each object, with it."""

    def __init__(self, wants_json: bool) -> None:
        self._wants_json = wants_json
        self._lines: dict[Host, Lines] = {}

    def said(self, host: Host, data: bytes) -> DoraSystemdError | None:
        """Print the lines that are complete."""
        return self._print(host, self._lines.setdefault(host, Lines()).feed(data))

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """Print the last line."""
        del error
        return self._print(host, self._lines.pop(host, Lines()).flush())

    def finish(self) -> None:
        """Nothing: all is printed."""

    def _print(self, host: Host, lines: list[str]) -> DoraSystemdError | None:
        for line in lines:
            if not self._wants_json:
                click.echo(f"{host.text}: {line}")
            elif (found := objects_of(line, host.text)) is None:
                return invalid(host)
            else:
                click.echo("\n".join(map(format_json, found)))
        return None


class Whole:
    """Collects the output of each host, for a printer that needs all of it."""

    def __init__(self) -> None:
        self.texts: dict[Host, bytearray] = {}

    def said(self, host: Host, data: bytes) -> DoraSystemdError | None:
        """Keep it."""
        text = self.texts.setdefault(host, bytearray())
        text += data
        return too_much(host) if len(text) > MOST_BYTES else None

    def take(self, host: Host) -> str:
        """All that this host has said."""
        return self.texts.pop(host, bytearray()).decode("utf-8", "replace")


class BlockPrinter(Whole):
    """The whole text of a host, below its name, as head(1) and tail(1) do with files."""

    def __init__(self, hosts: Sequence[Host]) -> None:
        super().__init__()
        self._waiting = list(hosts)
        self._ended: set[Host] = set()
        self._gap = ""

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """Print the texts of all hosts whose turn it is, in the order of the command line."""
        del error
        self._ended.add(host)
        while self._waiting and self._waiting[0] in self._ended:
            self._print(self._waiting.pop(0))
        return None

    def _print(self, host: Host) -> None:
        if text := self.take(host).rstrip("\n"):
            click.echo(f"{self._gap}==> {host.text} <==\n{text}")
            self._gap = "\n"

    def finish(self) -> None:
        """Nothing: all is printed."""


class JsonPrinter(Whole):
    """One list, with the objects of all hosts in the order of the hosts."""

    def __init__(self, hosts: Sequence[Host]) -> None:
        super().__init__()
        self._found: dict[Host, list[dict[str, object]]] = {host: [] for host in hosts}

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """Read it."""
        text = self.take(host).strip()
        if error or not text:
            return None
        found = objects_of(text, host.text)
        self._found[host] = found or []
        return invalid(host) if found is None else None

    def finish(self) -> None:
        """Print the list."""
        click.echo(format_json([one for some in self._found.values() for one in some], indent=2))


class Complaints:
    """What hosts write to standard error, and errors of hosts. is_json: as objects."""

    def __init__(self, is_json: bool) -> None:
        self._is_json = is_json
        self._lines: dict[Host, Lines] = {}

    def said(self, host: Host, data: bytes) -> None:
        """Print the lines that are complete."""
        for line in self._lines.setdefault(host, Lines()).feed(data):
            self._print(host, line)

    def ended(self, host: Host, error: DoraSystemdError | None) -> None:
        """Print the last line, and the error."""
        for line in self._lines.pop(host, Lines()).flush():
            self._print(host, line)
        if error and self._is_json:
            self._print_object(host, {"error": error_object(error)})
        elif error:
            print_error(error, is_json=False)

    def _print(self, host: Host, line: str) -> None:
        value = read_object(line)
        if self._is_json:
            self._print_object(host, value or {"warning": {"message": line}})
        elif value is not None:  # asked for JSON, to read the answer
            self._print_words(host, value)
        else:
            rest = line.removeprefix("doractl: ")
            word = "doractl: " if rest != line else ""
            print(f"{word}{host.text}: {rest}", file=sys.stderr)

    def _print_words(self, host: Host, value: dict[str, object]) -> None:
        for found in (value.get("error"), value.get("warning")):
            if isinstance(found, dict):
                lines = found.get("lines")
                for line in lines if isinstance(lines, list) else ():
                    print(f"{host.text}:   {one_line(str(line))}", file=sys.stderr)
                print(
                    f"doractl: {host.text}: {one_line(str(found.get('message')))}", file=sys.stderr
                )
                if hint := found.get("hint"):
                    print(f"{host.text}: hint: {one_line(str(hint))}", file=sys.stderr)

    def _print_object(self, host: Host, value: dict[str, object]) -> None:
        print(format_json(with_host(value, host.text)), file=sys.stderr)
