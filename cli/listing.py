"""`doractl list` without click, which takes longer to import than the list takes."""

import os
import sys
from contextlib import suppress
from typing import Any, NamedTuple

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.views.dataflows import (
    DataflowRow,
    format_dataflows,
    is_up_word,
)
from dora_systemd.errors import ExitCode
from dora_systemd.scope import Scope, scope_of
from dora_systemd.verbs.facts.list import mark_enabled, read_rows

_FLAGS: dict[str, dict[str, Any]] = {
    "-a": {"want_all": True},
    "--all": {"want_all": True},
    "--user": {"is_user": True},
    "--system": {"is_user": False},
    "--output=json": {"output": "json"},
    "--output=table": {"output": "table"},
}
"""What click makes of the options of `list`; test_command.py compares the two."""


class ListRequest(NamedTuple):
    """A `doractl list` command. is_user: None without --user and --system."""

    selector: str | None = None
    want_all: bool = False
    output: str = "table"
    is_user: bool | None = None


def parse_list(arguments: list[str]) -> ListRequest | None:
    """The request in `[--all] [--user|--system] [-o json|table] [SELECTOR]`, else None.

    None also for every wrong command line: click reports the error.
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
    """Print the list; NOT_RUNNING if a single dataflow was requested and is not up."""
    scope = scope_of(request.is_user)
    bus = Bus(scope, for_reading=True)
    if request.selector is None:
        _print_all(_rows(bus, scope, request), request)
        return ExitCode.OK
    # Imported late: the table of all dataflows does without it, and is asked for most often.
    from dora_systemd.decisions.views.details import format_dataflow
    from dora_systemd.decisions.views.objects import dataflow_object, format_json
    from dora_systemd.verbs.list import find_row

    row = find_row(bus, scope, request.selector)
    is_json = request.output == "json"
    print(format_json(dataflow_object(row), indent=2) if is_json else format_dataflow(row))
    return ExitCode.OK if is_up_word(row) else ExitCode.NOT_RUNNING


def _rows(bus: Bus, scope: Scope, request: ListRequest) -> list[DataflowRow]:
    if request.output == "json":
        from dora_systemd.verbs.list import all_rows

        rows = all_rows(bus, scope)
    else:
        rows = read_rows(bus, scope, with_details=False)
    if not request.want_all:
        return [row for row in rows if is_up_word(row)]
    # Only dataflows that systemd has unloaded need the journal.
    from dora_systemd.verbs.facts.ended import ended_rows

    return mark_enabled(bus, scope, [*rows, *ended_rows(scope, rows)])


def _print_all(rows: list[DataflowRow], request: ListRequest) -> None:
    if request.output == "json":
        from dora_systemd.decisions.views.objects import dataflow_object, format_json

        print(format_json(list(map(dataflow_object, rows)), indent=2))
    elif rows:
        print(format_dataflows(rows, _width()))
    else:
        print("No dataflow." if request.want_all else "No dataflow is running.")


def _width() -> int | None:
    """Columns of the terminal, None for a pipe; $COLUMNS has precedence, as in systemctl.

    Not by shutil, which imports every compressor. A pseudoterminal may have no size.
    """
    if not sys.stdout.isatty():
        return None
    with suppress(OSError, ValueError):
        return int(os.environ.get("COLUMNS", "0")) or os.get_terminal_size().columns or None
    return None
