"""`doractl set`: changes limits of a dataflow and its nodes, and makes them persistent.

systemd stores the limits of the dataflow, as for `systemctl set-property`. The limits of nodes are
in a drop-in of ours next to systemd's. Drop-ins of a transient unit disappear with the unit, those
of a unit file when the file is removed.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.cgroup.limits import limit_groups
from dora_systemd.adapters.runner_socket.client import order
from dora_systemd.decisions.cell import line_rates
from dora_systemd.decisions.cell.limits import BY_KEY, NodeLimits, check_nodes, node_limits
from dora_systemd.decisions.cell.machines import members_of
from dora_systemd.decisions.descriptor.nodes import UNEXPANDED
from dora_systemd.decisions.settings.limit_checks import (
    Used,
    check_cpus,
    check_kept,
    check_use,
    size_warnings,
)
from dora_systemd.decisions.settings.limits import LOG_RATE_LIMIT
from dora_systemd.decisions.settings.resolve import Settings, resolve_settings, runner_texts
from dora_systemd.decisions.settings.table import CHANGEABLE
from dora_systemd.decisions.unit.properties import settings_properties
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.cells import Cell, refuse_parts
from dora_systemd.verbs.facts.enabled import enabled_units
from dora_systemd.verbs.facts.reading import read_status
from dora_systemd.verbs.reload import Ask, limit_lines, remember, variables_of
from dora_systemd.verbs.start.limits import read_machine, require_controllers
from dora_systemd.verbs.start.read import written_dataflow

_PROPERTIES = ("ControlGroup", "Environment", "FragmentPath", "Transient")


def set_limits(
    manager: Manager,
    scope: Scope,
    cell: Cell,
    flags: Mapping[str, object],
    is_forced: bool = False,
    ask: Ask = order,
    first: Callable[[], object] = lambda: None,
) -> tuple[str, ...]:
    """Change limits of a dataflow, or of its next start if it does not run; return warnings.

    flags: raw values by name of CHANGEABLE. is_forced: also limits below the current
    usage. `ask`: sends a request to the runner. first: is called after all checks; what it raises
    prevents the change. Raises DoraSystemdError; then nothing is changed.
    """
    settings = resolve_settings(flags, {}, (), CHANGEABLE)
    properties, nodes, rates = settings_properties(settings), _limits(settings), _rates(settings)
    if not properties and not nodes and not rates:
        message = f"cannot change the limits of {cell.name}: none is given"
        raise usage_error(message, "see doractl set --help")
    refuse_parts([cell], "set")
    _refuse_placed(cell, [*(one.node for one in nodes), *rates])
    if not scope.is_callers:
        message = f"cannot change the limits of {cell.name}: permission denied"
        raise DoraSystemdError(message, "use sudo", ExitCode.NO_PERMISSION)
    _check_nodes(scope, cell, nodes, rates)
    check_cpus(nodes, read_machine())
    require_controllers(manager, scope, properties, nodes)
    unit = manager.read(cell.unit, _PROPERTIES)
    values = {key: settings.values[key] for key in BY_KEY}
    warnings = (*size_warnings(values, nodes, read_machine()), *_placed_warnings(cell, rates))
    _check_usage(unit, values, nodes, is_forced)
    first()
    # systemd stores drop-ins of a transient unit in /run in any case.
    is_fleeting = Path(unit["FragmentPath"]).is_relative_to("/run")
    # The kernel is the most likely to refuse, then systemd. `undo` reverts the steps before that.
    with ExitStack() as undo:
        _limit_groups(unit, nodes, undo)
        if nodes or rates:
            remember(unit, runner_texts(settings), undo)
        # systemd gives a unit that does not run a group, too, when it sets a property of it.
        if rates and cell.has_begun and unit["ControlGroup"]:
            limit_lines(scope, cell, variables_of(unit), rates, undo, ask)
        if properties:
            manager.set_properties(cell.unit, list(properties.values()), is_fleeting)
        if nodes or rates:
            manager.reload()
        undo.pop_all()
    return (*warnings, *_unit_file_warnings(manager, scope, cell, unit))


def _check_usage(
    unit: Mapping[str, Any], values: Mapping[str, Any], nodes: Sequence[NodeLimits], is_forced: bool
) -> None:
    """Raise DoraSystemdError for a limit below what is used, or of memory below what is kept."""
    if not unit["ControlGroup"]:
        return
    group = cgroup.group_path(unit["ControlGroup"])
    kept = cgroup.read_numbers(group / "memory.stat").get("shmem", 0)
    if not is_forced:
        held = {node: _used(one) for node, one in cgroup.node_groups(group).items()}
        check_use(values, nodes, _used(group), held)
    check_kept(values["memory_limit"], kept)


def _limits(settings: Settings) -> tuple[NodeLimits, ...]:
    found = (node_limits(node, values) for node, values in settings.nodes.items())
    return tuple(one for one in found if one.limits)


def _rates(settings: Settings) -> line_rates.RateLimits:
    of_all = {line_rates.ALL_NODES: settings[LOG_RATE_LIMIT]}
    of_nodes = settings.by_node(LOG_RATE_LIMIT)
    return {**(of_all if settings.is_given(LOG_RATE_LIMIT) else {}), **of_nodes}


def _refuse_placed(cell: Cell, nodes: Iterable[str]) -> None:
    """Raise DoraSystemdError (USAGE) for a node on another machine."""
    placed = dict(cell.options.placed)
    for node in nodes:
        if machine := placed.get(node):
            hint = f"stop {cell.name}, and start it with another limit"
            raise usage_error(f"cannot limit the node {node}: it runs on machine {machine}", hint)


def _placed_warnings(cell: Cell, rates: line_rates.RateLimits) -> list[str]:
    machines = members_of(cell.options.placed)
    if not machines or line_rates.ALL_NODES not in rates:
        return []
    return [f"the nodes on {', '.join(machines)} keep their limits of log lines"]


def _unit_file_warnings(
    manager: Manager, scope: Scope, cell: Cell, unit: Mapping[str, Any]
) -> list[str]:
    """Warnings for a dataflow that was enabled while running: it also has a unit file."""
    if not unit["Transient"] or cell.unit not in enabled_units(manager, scope):
        return []
    name = cell.name
    return [f"the next boot has the old limits, unless you disable {name} and enable it again"]


def _check_nodes(
    scope: Scope, cell: Cell, limits: tuple[NodeLimits, ...], rates: line_rates.RateLimits
) -> None:
    if not limits and not rates:
        return
    kinds = {node: one.kind for node, one in read_status(scope, cell).nodes.items()}
    if not kinds:
        written = written_dataflow(cell.options.dataflow).nodes
        if any(node.kind in UNEXPANDED for node in written):
            return  # only the runner expands these nodes, and would refuse them at the next start
        kinds = {node.id: str(node.kind) for node in written}
    line_rates.check_rates(rates, list(kinds))
    check_nodes(limits, kinds, [node for node, kind in kinds.items() if kind == "dynamic"])


def _used(group: Path) -> Used:
    """The memory and the tasks of a group."""
    tasks, _ = cgroup.read_tasks(group)
    return {"memory_limit": cgroup.read_usage(group).memory, "tasks_limit": tasks}


def _limit_groups(unit: Mapping[str, Any], nodes: tuple[NodeLimits, ...], undo: ExitStack) -> None:
    if not nodes or not unit["ControlGroup"]:
        return
    groups = cgroup.node_groups(cgroup.group_path(unit["ControlGroup"]))
    # A node that has no group reads the drop-in at its next start.
    known = [(groups[one.node], one) for one in nodes if one.node in groups]
    undo.enter_context(limit_groups(known))
