"""The tables of `doractl list` and `releases` of several hosts."""

import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, TypeVar

import click

from dora_systemd.cli.colors import wants_colors
from dora_systemd.cli.edge import write_own
from dora_systemd.cli.remote.printers import Whole
from dora_systemd.decisions.remote.failures import invalid
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.remote.stream import objects_of
from dora_systemd.errors import DoraSystemdError

Row = TypeVar("Row")
Shown = Callable[[Mapping[str, list[Row] | None], int | None, bool], str]
"""The table of the rows by host, None for a dead one; for a terminal of that width, in colours."""


class TablePrinter(Whole, Generic[Row]):
    """One table with a column HOST. nothing: printed instead of an empty one.

    parse: the row of an object, None for what is none.
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
        """Read its rows."""
        text = self.take(host).strip()
        if error:
            return None
        if not text:  # its doractl has said why on standard error
            self._found[host.text] = []
            return None
        found = objects_of(text, host.text)
        known = [row for row in map(self._parse, found or ()) if row is not None]
        if found is None or len(known) < len(found):
            return invalid(host)
        self._found[host.text] = known
        return None

    def finish(self) -> None:
        """Print the table."""
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        text = self._shown(self._found, width, wants_colors(sys.stdout))
        if text:
            write_own(sys.stdout, f"{text}\n")
        else:
            click.echo(self._nothing)
