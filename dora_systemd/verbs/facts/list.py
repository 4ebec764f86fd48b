"""`doractl list`: dataflows and their resource usage, a row for each."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.limits import CPUS, has_cpus, limits_of
from dora_systemd.decisions.cell.machines import members_of
from dora_systemd.decisions.cell.status import FAILED_BECAUSE, GATHERING, CellStatus
from dora_systemd.decisions.resources.usage import (
    WHOLE_CELL,
    CpuSample,
    Usage,
    cpu_percent,
    limit_of,
    throttled_percent,
    usage_facts,
)
from dora_systemd.decisions.views.dataflows import WITH_NODES
from dora_systemd.decisions.views.facts import OutputRow, node_row
from dora_systemd.decisions.views.rows import DataflowRow
from dora_systemd.scope import Scope
from dora_systemd.values import format_cpus
from dora_systemd.verbs.facts.cells import Cell, proven, read_cells
from dora_systemd.verbs.facts.enabled import enabled_units
from dora_systemd.verbs.facts.reading import (
    ENDED,
    PROCESS_STARTED,
    STARTED,
    UP_SINCE,
    Reading,
    read_dataflow,
    slice_group,
)

if TYPE_CHECKING:
    from dora_systemd.decisions.cell.rights import NodeRights


def row_of(reading: Reading, before: Reading | None = None) -> DataflowRow:
    """Return the row of one dataflow with all its facts.

    before: an earlier reading of the same run, the base for CPU and throttling; without it, the
    samples of the runner.
    """
    cell, unit, status = reading.cell, reading.unit, reading.status
    facts = {
        "uuid": cell.uuid,
        "name": cell.name,
        "unit": cell.unit,
        "status": reading.word,
        "dataflow": cell.dataflow,
        "listed_release": cell.release,
        # The status is "failed" already.
        "text": current_text(cell, _text(unit, status)).removeprefix(FAILED_BECAUSE),
        "restarts": unit["NRestarts"],
        "problem": reading.problem,
        "runner_version": status.version if status.uuid else "",
        "options_problem": cell.options_problem,
        "is_up": cell.is_up,
        **_machines(cell),
    }
    if held := reading.held:
        facts |= {"status": held.word, "text": held.text}
        return DataflowRow(**facts, needs=held.needs, waits_since=held.since_us)
    if not cell.is_up:
        return DataflowRow(**facts, ended=unit.get(ENDED) or 0)
    if not reading.usage:
        return DataflowRow(**facts)
    samples = (before.sample,) if before else status.samples
    return DataflowRow(**facts, **_life(reading), **_usage(reading, samples))


def _text(unit: Mapping[str, Any], status: CellStatus) -> str:
    """The STATUS= of a unit, or of the live table for a waiting dataflow in a row of the table."""
    return str(unit.get("StatusText", status.text if status.stage == GATHERING else ""))


def current_text(cell: Cell, text: str) -> str:
    """Return the STATUS= of a unit, "" for that of a runner that was killed.

    systemd keeps that STATUS= until the next start, such as "2/2 nodes running".
    """
    return text if text.startswith(FAILED_BECAUSE) or not cell.awaits_restart else ""


def _machines(cell: Cell) -> dict[str, Any]:
    """The machines of a dataflow; {} for a row of the table, which does not read the options."""
    options = cell.known_options
    if options is None or not options.placed:
        return {}
    here = options.machine
    return {"machine": here} if here else {"machines": members_of(options.placed)}


def dataflow_row(manager: Manager, scope: Scope, cell: Cell) -> DataflowRow:
    """The row of one dataflow."""
    return row_of(read_dataflow(manager, scope, cell))


def read_rows(manager: Manager, scope: Scope) -> list[DataflowRow]:
    """Read the rows of all dataflows that systemd has loaded."""
    cells = proven(read_cells(manager))
    rows = [dataflow_row(manager, scope, cell) for cell in cells]
    return mark_enabled(manager, scope, rows) if rows else []


def table_rows(manager: Manager, scope: Scope, cells: Sequence[Cell]) -> list[DataflowRow]:
    """Return the rows of the table, by a number of requests that does not depend on their number.

    Dataflows that are down, starting, stopping, or have been restarted need some requests each.
    """
    slice_path = slice_group(manager) if cells else None
    rows = [row_of(read_dataflow(manager, scope, cell, slice_path, is_row=True)) for cell in cells]
    return mark_enabled(manager, scope, rows) if rows else []


def mark_enabled(manager: Manager, scope: Scope, rows: Sequence[DataflowRow]) -> list[DataflowRow]:
    """Mark the rows of dataflows that are started at boot.

    Of several rows with the same unit the first is marked; the other dataflows are gone.
    """
    units = set(enabled_units(manager, scope))
    marked = []
    for row in rows:
        marked.append(row._replace(enabled=row.unit in units))
        units.discard(row.unit)
    return marked


def _life(reading: Reading) -> dict[str, Any]:
    """Times of the current run; the monotonic ones do not depend on the setting of the clock."""
    since, started = reading.unit[UP_SINCE], reading.unit.get(STARTED, 0)
    life = {"started": reading.unit.get(PROCESS_STARTED, 0)}
    if since < started:
        return {**life, "uptime": reading.at_us - started}
    ready_us = reading.unit.get("ActiveEnterTimestamp", 0)
    return {**life, "uptime": reading.at_us - since, "ready": ready_us}


def _usage(reading: Reading, known: tuple[CpuSample, ...]) -> dict[str, Any]:
    status, use, now = reading.status, reading.usage, reading.sample
    away = {node: one.facts() for node, one in reading.away.items()}
    rights = _rights(reading.cell)
    samples = known or (CpuSample(reading.unit[STARTED]),)
    groups = {key: path for key, path in reading.groups.items() if key != WHOLE_CELL}
    names = status.nodes or dict.fromkeys(groups)
    shown = names if not reading.is_row or reading.word in WITH_NODES else ()
    alive = status.alive_count if status.nodes else sum(map(cgroup.is_populated, groups.values()))
    return {
        **_numbers(use[WHOLE_CELL], samples, now, WHOLE_CELL),
        "nodes_total": len(names),
        "nodes_alive": alive,
        "nodes": tuple(
            node_row(
                node,
                status.nodes.get(node),
                {
                    **(_numbers(use[node], samples, now, node) if node in use else {}),
                    **away.get(node, {}),
                    **_signs(status, node, now.at_us),
                    **_stop_left(status, node, now.at_us),
                    **_right_facts(rights, node),
                    **_tasks(reading, node),
                    "cpus": _cpus(reading, node),
                    "outputs": _outputs(reading, node),
                },
            )
            for node in shown
        ),
    }


def _rights(cell: Cell) -> "dict[str, NodeRights] | None":
    """The rights of nodes; None for a row of the table, which does not read the options."""
    options = cell.known_options
    if options is None or not options.settings:
        return options and {}
    # Imported late: few dataflows have any.
    from dora_systemd.decisions.cell.rights import rights_of

    return {one.node: one for one in rights_of(options)}


def _right_facts(rights: "dict[str, NodeRights] | None", node: str) -> dict[str, Any]:
    """The fields of a row about the rights of a node."""
    if rights is None or node not in rights:
        return {"essential": None if rights is None else False}
    own = rights[node]
    return {"essential": bool(own.essential), "scheduling": own.scheduling or ""}


def _tasks(reading: Reading, node: str) -> dict[str, Any]:
    """The fields of a row about the processes and threads of a node; {} in the table."""
    if (group := reading.groups.get(node)) is None:
        return {}
    tasks, limit = cgroup.read_tasks(group)
    return {"tasks": tasks, "tasks_limit": limit_of(limit)}


def _cpus(reading: Reading, node: str) -> str:
    """The CPUs of a node, if the settings name some; "" in the table."""
    options = reading.cell.known_options
    asked = [one for one in limits_of(options) if one.node == node] if options else []
    if not any(map(has_cpus, asked)):
        return ""
    # `doractl set` may have changed them. Without a cpuset controller the launcher binds the node.
    group = reading.groups.get(node)
    now = cgroup.read_cpus(group) if group else ""
    return now or format_cpus(dict(asked[0].limits)[CPUS])


def _outputs(reading: Reading, node: str) -> tuple[OutputRow, ...]:
    """The outputs that the node owes; none in the table."""
    if not reading.heard:
        return ()
    # Imported late: few dataflows owe anything.
    from dora_systemd.decisions.cell.owes import owes_of

    owes = owes_of(reading.cell.options)
    return tuple(
        OutputRow(owed.output, owed.within, owed.then, max(reading.at_us - at, 0) if at else None)
        for owed, at in zip(owes, reading.heard, strict=False)
        if owed.node == node
    )


def _signs(status: CellStatus, node: str, now_us: int) -> dict[str, Any]:
    """The fields of a row about the messages of a node to its notify socket."""
    if node not in status.signs:
        return {}
    from dora_systemd.decisions.watchdog.messages import parse_sign, sign_facts

    return sign_facts(parse_sign(status.signs[node]), now_us)


def _stop_left(status: CellStatus, node: str, now_us: int) -> dict[str, Any]:
    """The fields of a row about the stop of a node that has a time of its own."""
    due, one = status.stop_dues.get(node), status.nodes.get(node)
    is_there = one and (one.pid or (one.machine and one.is_alive))
    return {"stop_left": max(due - now_us, 0)} if due and is_there else {}


def _numbers(
    use: Usage, samples: tuple[CpuSample, ...], now: CpuSample, key: str
) -> dict[str, Any]:
    """Usage and limits of a group, as rows have them."""
    return usage_facts(use, cpu_percent(samples, now, key), throttled_percent(samples, now, key))
