"""Checks that this machine can enforce the limits of a dataflow."""

import os
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.decisions.cell.limits import BY_KEY, NodeLimits, has_cpus, limits_of, without_cpus
from dora_systemd.decisions.properties.assignments import Properties
from dora_systemd.decisions.recorder.record import check_memory
from dora_systemd.decisions.settings.limit_checks import (
    Machine,
    check_controllers,
    check_cpus,
    needed_controllers,
    size_warnings,
)
from dora_systemd.decisions.settings.limits import DEVICE, NICE
from dora_systemd.decisions.settings.record import RECORD
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.values import cpu_numbers, parse_cpus
from dora_systemd.verbs.start.plan import Plan

_KIB = 1024
_ONLINE = Path("/sys/devices/system/cpu/online")


def check_limits(manager: Manager, plan: Plan, properties: Properties) -> tuple[str, ...]:
    """Warnings about limits above the machine's size, and about missing devices.

    Raises DoraSystemdError (NO_SYSTEMD) for a limit that nothing would enforce.
    """
    nodes, machine = limits_of(plan.options), read_machine()
    check_cpus(nodes, machine)
    if record := plan.settings[RECORD]:
        check_memory(record, machine.memory)
    # Without a cpuset controller the launcher binds nodes to their CPUs.
    require_controllers(manager, plan.scope, properties, tuple(map(without_cpus, nodes)))
    values = {key: plan.settings.values[key] for key in BY_KEY}
    sizes = size_warnings(values, nodes, machine)
    return (*sizes, *_missing_devices(plan), *_powerless(plan), *_unbound(manager, nodes))


def _unbound(manager: Manager, nodes: tuple[NodeLimits, ...]) -> list[str]:
    """Nodes that nothing keeps on their CPUs but their own good will."""
    bound = [one.node for one in nodes if has_cpus(one)]
    if not bound or cgroup.CPUSET in cgroup.read_controllers(
        cgroup.group_path(manager.control_group())
    ):
        return []
    names = ", ".join(bound)
    return [f"systemd has no cpuset controller here: {names} can leave the CPUs of `cpus`"]


def require_controllers(
    manager: Manager, scope: Scope, properties: Properties, nodes: tuple[NodeLimits, ...]
) -> None:
    """Raise DoraSystemdError (NO_SYSTEMD) for a limit whose controller this manager lacks."""
    if needed := needed_controllers(properties, nodes):
        available = cgroup.read_controllers(cgroup.group_path(manager.control_group()))
        check_controllers(needed, available, scope.is_user)


def _powerless(plan: Plan) -> list[str]:
    """Limits that a user's manager accepts but cannot enforce."""
    if not plan.scope.is_user:
        return []
    nice = plan.settings[NICE]
    warnings = ["devices cannot be closed in user scope"] if plan.settings[DEVICE] else []
    if nice is not None and nice < 0:
        warnings.append(f"the nice value {nice} needs LimitNICE= of the user's manager")
    return warnings


def _missing_devices(plan: Plan) -> list[str]:
    paths = (device.partition(" ")[0] for device in plan.settings[DEVICE])
    return [
        f"there is no device {path}"
        for path in paths
        if path.startswith("/") and not Path(path).exists()
    ]


def read_machine() -> Machine:
    """Bytes of memory, number of processors and maximum tasks. Raises OSError without /proc."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    total = next(int(line.split()[1]) for line in lines if line.startswith("MemTotal:"))
    tasks = int(Path("/proc/sys/kernel/pid_max").read_text())
    return Machine(total * _KIB, os.cpu_count() or 1, tasks, _online())


def _online() -> frozenset[int] | None:
    """The online CPUs, see sysfs's cpu/online in the kernel's cputopology document."""
    try:
        return frozenset(cpu_numbers(parse_cpus(_ONLINE.read_text())))
    except (OSError, DoraSystemdError):
        return None
