"""The table of `doractl list` of several hosts."""

import shutil
import sys
from collections.abc import Sequence

import click

from dora_systemd.cli.colors import wants_colors
from dora_systemd.cli.edge import write_own
from dora_systemd.cli.remote.printers import Whole
from dora_systemd.decisions.remote.failures import invalid
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.remote.stream import objects_of
from dora_systemd.decisions.remote.table import format_hosts, row_of
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import DoraSystemdError


class TablePrinter(Whole):
    """One table with a column HOST. nothing: printed instead of an empty one."""

    def __init__(self, hosts: Sequence[Host], sort_by: str | None, nothing: str) -> None:
        super().__init__()
        self._found: dict[str, list[DataflowRow] | None] = {one.text: None for one in hosts}
        self._sort_by = sort_by
        self._nothing = nothing

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """Read its rows."""
        text = self.take(host).strip()
        if error or not text:
            return None
        found = objects_of(text, host.text)
        known = [row for row in map(row_of, found or ()) if row]
        if found is None or len(known) < len(found):
            return invalid(host)
        self._found[host.text] = known
        return None

    def finish(self) -> None:
        """Print the table."""
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        text = format_hosts(self._found, self._sort_by, width, wants_colors(sys.stdout))
        if text:
            write_own(sys.stdout, f"{text}\n")
        else:
            click.echo(self._nothing)
