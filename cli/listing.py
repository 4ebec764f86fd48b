"""The output of `doractl list`; works without click, see main."""

import json

from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.cli.quick import ListRequest
from dora_systemd.decisions.views.dataflows import (
    DataflowRow,
    format_dataflow,
    format_dataflows,
    is_up_word,
    row_values,
)
from dora_systemd.errors import ExitCode
from dora_systemd.scope import Scope, scope_of
from dora_systemd.verbs.facts.list import find_row, read_rows


def print_dataflows(request: ListRequest) -> int:
    """Print the list; NOT_RUNNING if a single dataflow was requested and is not up."""
    scope = scope_of(request.is_user)
    bus = Bus(scope, for_reading=True)
    if request.selector is None:
        _print_all(_rows(bus, scope, request), request)
        return ExitCode.OK
    row = find_row(bus, scope, request.selector)
    print(json.dumps(row_values(row), indent=2) if is_json(request) else format_dataflow(row))
    return ExitCode.OK if is_up_word(row) else ExitCode.NOT_RUNNING


def is_json(request: ListRequest) -> bool:
    """Whether the output is JSON."""
    return request.output == "json"


def _rows(bus: Bus, scope: Scope, request: ListRequest) -> list[DataflowRow]:
    rows = read_rows(bus, scope, with_details=is_json(request))
    if not request.want_all:
        return [row for row in rows if is_up_word(row)]
    # Only dataflows that systemd has unloaded need the journal.
    from dora_systemd.verbs.facts.ended import ended_rows

    return [*rows, *ended_rows(scope, rows)]


def _print_all(rows: list[DataflowRow], request: ListRequest) -> None:
    if is_json(request):
        print(json.dumps([row_values(row) for row in rows], indent=2))
    elif rows:
        print(format_dataflows(rows))
    else:
        print("No dataflow." if request.want_all else "No dataflow is running.")
