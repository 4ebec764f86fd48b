"""`doractl list` without click, which takes longer to import than the list takes."""

import os
import sys
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.edge import remember_scope, write_view
from dora_systemd.decisions.views.dataflows import format_dataflows, is_up_word
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import SLICE
from dora_systemd.scope import Scope, scope_of
from dora_systemd.terminal_text import cut, one_line
from dora_systemd.verbs.facts.cells import read_cells

_FLAGS: dict[str, dict[str, Any]] = {
    "-a": {"want_all": True},
    "--all": {"want_all": True},
    "--user": {"is_user": True},
    "--system": {"is_user": False},
    "--output=json": {"output": "json"},
    "--output=table": {"output": "table"},
    "-q": {"is_quiet": True},
    "--quiet": {"is_quiet": True},
}
"""What click makes of the options of `list`; test_command.py compares the two."""

_MORE = "Why: doractl why NAME; all runs: doractl logs NAME --run ALL"
"""Below a table with ended dataflows, for a person."""


class ListRequest(NamedTuple):
    """A `doractl list` command."""

    selector: str | None = None
    want_all: bool = False
    output: str = "table"
    is_user: bool | None = None  # None without --user and --system
    is_quiet: bool = False
    last: int | None = None  # the maximum number of ended dataflows
    # status, pattern, sort_by: see matching_rows() and sorted_rows()
    status: str | None = None
    pattern: str | None = None
    sort_by: str | None = None

    @property
    def is_filtered(self) -> bool:
        """Whether the request has one of the rare options of the list of all dataflows."""
        return any(one is not None for one in (self.last, self.status, self.pattern, self.sort_by))

    @property
    def is_pattern(self) -> bool:
        """Whether the selector is a pattern for several dataflows."""
        if self.selector is None:
            return False
        # Imported late: the usual list has no selector.
        from dora_systemd.verbs.facts.selector import is_pattern

        return is_pattern(self.selector)


def parse_list(arguments: list[str]) -> ListRequest | None:
    """The request in `[--all] [-q] [--user|--system] [-o json|table] [SELECTOR]`, else None.

    None also for other options, and for every wrong command line: click reports the error.
    """
    request = ListRequest()
    rest = iter(arguments)
    for word in rest:
        flag = f"--output={next(rest, '')}" if word in ("-o", "--output") else word
        if flag in _FLAGS:
            request = request._replace(**_FLAGS[flag])
        elif flag and not flag.startswith("-") and request.selector is None:
            request = request._replace(selector=flag)
        else:
            return None
    return request


def print_dataflows(request: ListRequest) -> int:
    """Print the list; NOT_RUNNING if a single dataflow was requested and is not up.

    Raises DoraSystemdError: USAGE for options that exclude each other.
    """
    _check(request)
    if request.is_user is not None:
        remember_scope(request.is_user)
    scope = scope_of(request.is_user)
    bus = Bus(scope, for_reading=True)
    if request.selector is None or request.is_pattern:
        _print_all(_fitting(_rows(bus, scope, request), request), request)
        return ExitCode.OK
    # Imported late: the table of all dataflows, the most frequent output, does not need it.
    from dora_systemd.decisions.views.details import format_dataflow
    from dora_systemd.verbs.list import find_row

    row = find_row(bus, scope, request.selector)
    if request.is_quiet:
        print(row.uuid)
    elif request.output == "json":
        _print_json(row)
    else:
        _print_view(format_dataflow(row, terminal_width(), want_colors=_wants_colors()))
    return ExitCode.OK if is_up_word(row) else ExitCode.NOT_RUNNING


def _check(request: ListRequest) -> None:
    if request.is_quiet and request.output == "json":
        raise usage_error("cannot use --quiet with JSON", "omit one of them")
    if request.selector is not None and request.is_filtered and not request.is_pattern:
        hint = "--last, --status, --name and --sort-by are for the list of all dataflows"
        raise usage_error("cannot filter a single dataflow", hint)


def _rows(bus: Manager, scope: Scope, request: ListRequest) -> list[DataflowRow]:
    is_plain = not request.want_all and not request.is_filtered
    cells = [cell for cell in read_cells(bus) if cell.is_up or cell.has_failed or not is_plain]
    if is_plain and not cells:
        return []
    # Imported late: where nothing runs, a script that calls `list` each second needs none of these.
    from dora_systemd.verbs.facts.list import mark_enabled, table_rows

    if request.output == "json":
        from dora_systemd.verbs.list import all_rows

        rows = all_rows(bus, scope, cells)
    else:
        rows = table_rows(bus, scope, cells)
    found = [row for row in rows if is_up_word(row)]
    if is_plain:
        # The UUIDs are for commands that act on what runs.
        return found if request.is_quiet else [*_failed(bus, scope, rows), *found]
    # Only dataflows that have ended need the journal, and few commands select some rows.
    from dora_systemd.decisions.views.selection import is_of_the_past, matching_rows, sorted_rows
    from dora_systemd.verbs.facts.ended import newest_ended

    found = matching_rows(found, request.status, request.pattern)
    if request.want_all or request.last or is_of_the_past(request.status):
        is_every = request.status is None and request.pattern is None
        past = newest_ended(bus, scope, rows, request.last if is_every else None)
        past = mark_enabled(bus, scope, past)
        found += matching_rows(past, request.status, request.pattern)[: request.last]
    return sorted_rows(found, request.sort_by)


def _failed(bus: Manager, scope: Scope, rows: list[DataflowRow]) -> list[DataflowRow]:
    """The failed dataflows that systemd keeps, with the reason; only these need the journal."""
    failed = [row for row in rows if not is_up_word(row)]
    if not failed:
        return []
    from dora_systemd.verbs.facts.ended import read_end, with_cause

    return [with_cause(scope, read_end(bus, scope, row)) for row in failed]


def _fitting(rows: list[DataflowRow], request: ListRequest) -> list[DataflowRow]:
    """The rows that the selector means, if it is a pattern."""
    if request.selector is None or not rows:
        return rows
    from dora_systemd.verbs.facts.selector import selectors_of

    names = {one.text for one in selectors_of([request.selector], rows)}
    return [row for row in rows if row.name in names]


def _print_all(rows: list[DataflowRow], request: ListRequest) -> None:
    if request.is_quiet:
        print(*(row.uuid for row in rows), sep="\n", end="\n" if rows else "")
    elif request.output == "json":
        _print_json(rows)
    elif rows:
        width = terminal_width()
        _print_view(format_dataflows(rows, width, want_colors=_wants_colors()))
        if width is not None and not all(map(is_up_word, rows)):
            print(f"\n{_MORE}")
        if width is not None and (others := [row for row in rows if row.upgrade[0]]):
            lines = (cut(one_line(f"{one.name} {': '.join(one.upgrade)}"), width) for one in others)
            print("", *lines, sep="\n")
    else:
        _print_nothing(request)


def _print_nothing(request: ListRequest) -> None:
    """Print that there is no row, and for an ordinary user the count of the system's dataflows."""
    if request.want_all or request.is_filtered:
        print("No dataflow.")
        return
    print("No dataflow is running.")
    if not scope_of(request.is_user).is_user:
        return
    # Imported late: most lists have a row.
    from dora_systemd.adapters.cgroup.groups import count_units
    from dora_systemd.decisions.gateway.place import SERVICE_UNIT

    with suppress(DoraSystemdError):
        if count := count_units(SLICE, SERVICE_UNIT):
            print(f"In system scope: {count} (doractl list --system)")


def _print_json(found: DataflowRow | list[DataflowRow]) -> None:
    from dora_systemd.decisions.views.objects import dataflow_object, format_json

    if isinstance(found, DataflowRow):
        print(format_json(dataflow_object(found), indent=2))
    else:
        print(format_json([dataflow_object(row) for row in found], indent=2))


def print_table(form: Callable[[int | None, bool], str]) -> None:
    """Print a table or a report. form: makes it for a width, with or without colours."""
    _print_view(form(terminal_width(), _wants_colors()))


def _print_view(text: str) -> None:
    """Print a text in which nothing but our own colours can control the terminal."""
    write_view(sys.stdout, f"{text}\n")


def _wants_colors() -> bool:
    # Imported late: most lists that are not for a terminal do without it.
    if not sys.stdout.isatty() and "SYSTEMD_COLORS" not in os.environ:
        return False
    from dora_systemd.cli.terminal import wants_colors

    return wants_colors(sys.stdout)


def terminal_width() -> int | None:
    """Columns of the terminal, None for a pipe; $COLUMNS has precedence, as in systemctl.

    Not by shutil, which imports every compressor. A pseudoterminal may have no size.
    """
    if not sys.stdout.isatty():
        return None
    with suppress(ValueError):
        if (columns := int(os.environ.get("COLUMNS", "0"))) > 0:
            return columns
    with suppress(OSError):
        return os.get_terminal_size().columns or None
    return None
