"""The rights of single nodes in the cell: what the launcher sets, and proof that it can."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from dora_systemd.adapters.cgroup import groups as cgroup
from dora_systemd.adapters.host.rights import check_cpus, prove_rights, read_base
from dora_systemd.decisions.cell.limits import CPUS, has_cpus, limits_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.rights import (
    NodeRights,
    format_commands,
    rights_commands,
    rights_of,
)
from dora_systemd.values import format_cpus

_OF_UNITS = r"/(dora-|doractl-check-)[^/]+\.service(/|$)"


def launcher_rights(options: RunnerOptions, unit: Path) -> str:
    """Return the programs through which launcher.pl executes the nodes, a line for each node.

    unit: cgroup directory. Without a cpuset controller the launcher binds nodes to their CPUs.
    """
    has_cpuset = cgroup.CPUSET in cgroup.read_controllers(unit)
    loose = () if has_cpuset else filter(has_cpus, limits_of(options))
    bound = {one.node: format_cpus(dict(one.limits)[CPUS]) for one in loose}
    if not rights_of(options) and not bound:
        return ""
    return format_commands(rights_commands(rights_of(options), read_base(bound)))


def check_first(
    options: RunnerOptions,
    group: str | None = None,
    prove: Callable[[Sequence[NodeRights]], None] = prove_rights,
) -> None:
    """Prove that this machine grants the rights of single nodes, and has their CPUs.

    Raises DoraSystemdError. group: that of this process, None to read it from the kernel.
    """
    # A dry run of a user is in no unit, and has the rights of that shell.
    if re.search(_OF_UNITS, group or cgroup.group_of()):
        check_cpus(limits_of(options))
        prove(rights_of(options))
