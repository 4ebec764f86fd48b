"""`doractl reload`, and parts of `doractl set`: requests to the runner of a dataflow."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.host.unit_files import (
    SET_FILE,
    drop_in_directory,
    put_unit_file,
    read_unit_file,
    remove_empty,
    write_unit_file,
)
from dora_systemd.adapters.runner_socket.client import done_of, order
from dora_systemd.decisions.cell.environment import changes_entry, changes_of, with_changes
from dora_systemd.decisions.cell.line_rates import RateLimits, rate_texts, rates_of
from dora_systemd.decisions.cell.options import SettingText, changed, format_setting
from dora_systemd.decisions.descriptor.nodes import UNEXPANDED
from dora_systemd.decisions.properties.assignments import typed
from dora_systemd.decisions.recorder.record import (
    Record,
    check_memory,
    check_record,
    format_record,
    parse_record,
)
from dora_systemd.decisions.unit.properties import format_unit
from dora_systemd.errors import usage_error
from dora_systemd.names import release_of
from dora_systemd.scope import Scope
from dora_systemd.values import format_bool
from dora_systemd.verbs.facts.cells import Cell, refuse_parts
from dora_systemd.verbs.node import patient, require_node, require_running, socket_of
from dora_systemd.verbs.start.limits import read_machine
from dora_systemd.verbs.start.read import written_dataflow

Ask = Callable[[Path, Mapping[str, Any]], dict[str, Any]]


def reload_cell(scope: Scope, cell: Cell, node: str | None, ask: Ask | None = None) -> list[str]:
    """Have the runner reload; what was done. Empty if no file has changed and no node is named.

    Raises DoraSystemdError; then the old version keeps running.
    """
    require_running(cell)
    refuse_parts([cell], "reload")
    _refuse_release(cell, f"reload {cell.name}")
    if node is not None:
        require_node(scope, cell, node)
    path, ask = socket_of(scope, cell), ask or patient(cell)
    return done_of(path, ask(path, {"verb": "reload", "node": node}))


def switch_hot_reload(
    manager: Manager, scope: Scope, cell: Cell, is_on: bool, ask: Ask = order
) -> None:
    """Switch hot reload on or off for a dataflow; this outlasts restarts of its unit.

    Raises DoraSystemdError.
    """
    check_hot_reload(cell, is_on)
    with _remembered(manager, cell, SettingText("", "hot_reload", format_bool(is_on))):
        ask(socket_of(scope, cell), {"verb": "hot-reload", "on": is_on})


def check_hot_reload(cell: Cell, is_on: bool) -> None:
    """Raise DoraSystemdError if hot reload of the dataflow cannot be switched on or off."""
    require_running(cell)
    refuse_parts([cell], "set")
    _refuse_release(cell, f"set the hot reload of {cell.name}")
    if is_on:
        # Imported late: asyncio is slow to import.
        from dora_systemd.adapters.host.watch import require_watcher

        require_watcher()


def switch_record(
    manager: Manager, scope: Scope, cell: Cell, text: str, ask: Ask = order
) -> tuple[str, ...]:
    """Change what the recorder keeps; this outlasts restarts of the unit. Return warnings.

    text: of the setting `record`. Raises DoraSystemdError.
    """
    record, has_recorder = checked_record(cell, text), cell.options.has("record")
    what = format_record(record)
    with _remembered(manager, cell, SettingText("", "record", what)):
        if has_recorder:
            ask(socket_of(scope, cell), {"verb": "record", "what": what})
    if has_recorder or record is None:
        return ()
    restart = f"doractl restart {cell.name}"
    return (f"{cell.name} was started without record, and records from its restart on: {restart}",)


def checked_record(cell: Cell, text: str) -> Record | None:
    """What to record, from the text of the setting. Raises DoraSystemdError."""
    require_running(cell)
    refuse_parts([cell], "set")
    record = parse_record(text)
    if record is not None and not cell.options.has("record"):
        # There is no recorder yet that would refuse it, but the next start does.
        check_memory(record, read_machine().memory)
        nodes = written_dataflow(cell.options.dataflow).nodes
        if not any(node.kind in UNEXPANDED for node in nodes):
            check_record(record, cell.options, nodes)
    return record


@contextmanager
def _remembered(manager: Manager, cell: Cell, change: SettingText) -> Iterator[None]:
    """Let the next runner get a change; undone, also in systemd, if the block fails."""
    unit = manager.read(cell.unit, ("Environment", "FragmentPath", "Transient"))
    with ExitStack() as undo:
        undo_last = undo.enter_context(ExitStack())
        remember(unit, [change], undo)
        manager.reload()
        undo_last.callback(manager.reload)
        yield
        undo.pop_all()


def remember(unit: Mapping[str, Any], changes: Iterable[SettingText], undo: ExitStack) -> None:
    """Add changes to our drop-in. Once systemd has loaded it, the next runner gets the changes.

    undo: gets what restores the file. Raises DoraSystemdError.
    """
    every = changed(changes_of(variables_of(unit)), changes)
    text = format_unit(typed(Environment=(changes_entry(every),)))
    directory = drop_in_directory(Path(unit["FragmentPath"]), bool(unit["Transient"]))
    path = directory / SET_FILE
    undo.callback(_put_back, path, read_unit_file(path))
    write_unit_file(path, f"# Written by doractl set.\n{text}")


def variables_of(unit: Mapping[str, Any]) -> dict[str, str]:
    """The variables in Environment= of a unit."""
    return dict(entry.partition("=")[::2] for entry in unit["Environment"] or ())


def _put_back(path: Path, text: str | None) -> None:
    put_unit_file(path, text)
    remove_empty(path.parent)


def limit_lines(
    scope: Scope,
    cell: Cell,
    environment: Mapping[str, str],
    given: RateLimits,
    undo: ExitStack,
    ask: Ask = order,
) -> None:
    """Have the runner apply limits of log lines, with those that it has. Raises DoraSystemdError.

    environment: that of the unit before the change. undo: gets what restores the limits.
    """
    path, before = socket_of(scope, cell), rates_of(with_changes(cell.options, environment))
    ask(path, _rates_request({**before, **given}))
    undo.callback(ask, path, _rates_request(before))


def _rates_request(rates: RateLimits) -> Mapping[str, Any]:
    return {"verb": "log-rates", "limits": [*map(format_setting, rate_texts(rates))]}


def _refuse_release(cell: Cell, action: str) -> None:
    """Raise DoraSystemdError (USAGE) for a deployed dataflow, whose files do not change."""
    if release := release_of(cell.options.dataflow):
        message = f"cannot {action}: the files of its release {release} do not change"
        raise usage_error(message, f"doractl deploy --name {cell.name} brings a new version")
