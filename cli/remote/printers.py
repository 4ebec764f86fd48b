"""Prints the output of several hosts, each line, object, row or record with its host."""

import json
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, Protocol, TypeVar

import click

from dora_systemd.cli.edge import print_error, write_own
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.cli.terminal import wants_colors
from dora_systemd.decisions.logs.query import journal_timestamp
from dora_systemd.decisions.logs.terminal import TerminalLines
from dora_systemd.decisions.remote.command_line import with_output
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.remote.merge import TIME, Merge, Records, time_of
from dora_systemd.decisions.remote.ssh_failures import invalid, too_much
from dora_systemd.decisions.remote.stream import Lines, objects_of, read_object, with_host
from dora_systemd.decisions.views.objects import error_object, format_json
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.terminal_text import one_line, shown_log

MOST_BYTES = 64 << 20
"""Maximum bytes of the answer of one host that is printed as a whole."""


class Printer(Protocol):
    """Takes the output of hosts."""

    def said(self, host: Host, data: bytes) -> DoraSystemdError | None:
        """Take what was written; the error of a host that goes too far."""

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """Take the end of a host; the error of a host whose answer is not valid."""

    def finish(self) -> None:
        """Print what waits for the end of all."""


class LinePrinter:
    """Prints each line at once, after its host; or each object, with its host."""

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
        text = self.texts.setdefault(host, bytearray())
        text += data
        return too_much(host) if len(text) > MOST_BYTES else None

    def take(self, host: Host) -> str:
        """Return the whole output of a host, and discard it."""
        return self.texts.pop(host, bytearray()).decode("utf-8", "replace")

    def finish(self) -> None:
        """Nothing: all is printed."""


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


class JsonPrinter(Whole):
    """Prints one list, with the objects of all hosts in the order of the hosts."""

    def __init__(self, hosts: Sequence[Host]) -> None:
        super().__init__()
        self._found: dict[Host, list[dict[str, object]]] = {host: [] for host in hosts}

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        text = self.take(host).strip()
        if error or not text:
            return None
        found = objects_of(text, host.text)
        self._found[host] = found or []
        return invalid(host) if found is None else None

    def finish(self) -> None:
        click.echo(format_json([one for some in self._found.values() for one in some], indent=2))


class Complaints:
    """Prints the standard error of hosts, and errors of hosts. is_json: as objects."""

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
        elif value is not None:  # JSON was requested only to read the answer
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


Row = TypeVar("Row")
Shown = Callable[[Mapping[str, list[Row] | None], int | None, bool], str]
"""The table of the rows by host, None for a dead one; for a terminal of that width, in colours."""


class TablePrinter(Whole, Generic[Row]):
    """Prints one table with a column HOST. nothing: printed instead of an empty table.

    parse: returns the row of an object, None for an invalid object.
    """

    def __init__(
        self,
        hosts: Sequence[Host],
        parse: Callable[[Mapping[str, Any]], Row | None],
        shown: Shown[Row],
        nothing: str,
    ) -> None:
        super().__init__()
        self._found: dict[str, list[Row] | None] = {one.text: None for one in hosts}
        self._parse, self._shown = parse, shown
        self._nothing = nothing

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        text = self.take(host).strip()
        if error:
            return None
        if not text:  # doractl of that host has reported the reason on standard error
            self._found[host.text] = []
            return None
        found = objects_of(text, host.text)
        known = [row for row in map(self._parse, found or ()) if row is not None]
        if found is None or len(known) < len(found):
            return invalid(host)
        self._found[host.text] = known
        return None

    def finish(self) -> None:
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        text = self._shown(self._found, width, wants_colors(sys.stdout))
        if text:
            write_own(sys.stdout, f"{text}\n")
        else:
            click.echo(self._nothing)


FORMS = {"short": "export", "cat": "export", "json": "json"}
"""The output that is requested from the hosts, by the -o of the caller."""


def words_of_logs(plan: Plan) -> list[str]:
    """Return the command for each host. Raises DoraSystemdError (USAGE)."""
    form = str(plan.options["output"])
    if form not in FORMS:
        raise usage_error(f"cannot merge -o {form} of several hosts", f"-o {' or -o '.join(FORMS)}")
    return with_output([*plan.words], FORMS[form])


class LogPrinter:
    """Merges the records. is_complete of Talks decides when the first ones may be printed.

    key: what JSON objects call the host.
    """

    def __init__(
        self, hosts: Sequence[Host], options: Mapping[str, Any], key: str = "host"
    ) -> None:
        self._key = key
        self._form = str(options["output"])
        is_follow = bool(options["is_follow"] or options["until_end"])
        names = [one.text for one in hosts]
        self.merge = Merge(names, is_follow, bool(options["is_reverse"]))
        self._records = {one: Records() for one in hosts}
        self._width = max(map(len, names))
        is_one = len(options["selectors"]) == 1
        has_colors = wants_colors(sys.stdout)
        self._terminal = TerminalLines(want_dataflow=not is_one, want_colors=has_colors)
        self._is_complete = False
        self._last = dict.fromkeys(hosts, 0)

    def said(self, host: Host, data: bytes) -> DoraSystemdError | None:
        records, now = self._records[host], time.monotonic()
        if self._form == "json":
            for value in records.objects(data):
                line = json.dumps(with_host(value, host.text, self._key)).encode() + b"\n"
                self._add(host, time_of(value.get(TIME)), line, now)
            return None
        for record in records.exported(data):
            self._add(host, int(record[TIME]), self._line(host, record), now)
        return too_much(host) if records.is_too_much else None

    def _add(self, host: Host, at_us: int, line: bytes, now: float) -> None:
        self._last[host] = max(self._last[host], at_us)
        self.merge.add(host.text, at_us, line, now)

    def again(self, host: Host, words: Sequence[str]) -> list[str]:
        """Return the command for a host that is reachable again: for lines after the last one."""
        self._records[host] = Records()
        self.merge.begin(host.text)
        since = self._last[host] + 1
        # Not only the last ones; without a line yet, as at first.
        return (
            [*words, f"--since={journal_timestamp(since)}", "-n", "all"] if since > 1 else [*words]
        )

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """Expect no more records of this host."""
        self.merge.end(host.text)
        return invalid(host) if error is None and self._records[host].is_unreadable else None

    def look(self, is_complete: bool) -> None:
        """Print what is due. is_complete: every host was reached or given up."""
        self._is_complete |= is_complete
        if self.merge.is_empty:
            return
        held = self.merge.take(time.monotonic(), self._is_complete)
        if text := b"".join(one.data for one in held):
            write_own(sys.stdout, text.decode("utf-8", "backslashreplace"))
            sys.stdout.flush()

    def finish(self) -> None:
        self.look(is_complete=True)

    def _line(self, host: Host, record: Mapping[str, bytes]) -> bytes:
        cat = shown_log(record.get("MESSAGE", b"")) + b"\n"
        text = cat if self._form == "cat" else self._terminal.record(record)
        start = f"{host.text:<{self._width}} ".encode()
        return b"".join(start + line + b"\n" for line in text[:-1].split(b"\n"))
