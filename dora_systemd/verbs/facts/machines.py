"""The other machines of a dataflow: systemd knows them by the units of the links.

Only doractl writes these units, so a host in them is what the user has named.
"""

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.decisions.cell.machines import members_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.machines.link_command import parse_link_command
from dora_systemd.decisions.machines.link_unit import link_unit_name
from dora_systemd.decisions.remote.hosts import Host, parse_host
from dora_systemd.errors import DoraSystemdError


def member_hosts(manager: Manager, options: RunnerOptions) -> dict[str, Host | None]:
    """The host of each member, by its name; None for one whose link systemd does not have."""
    if options.machine:
        return {}
    names = members_of(options.placed)
    return {one: _host(manager, link_unit_name(options.name, one)) for one in names}


def _host(manager: Manager, unit: str) -> Host | None:
    commands = manager.read(unit, ["ExecStart"]).get("ExecStart") or []
    try:
        return parse_host(parse_link_command(commands[0][1]).host)
    except (DoraSystemdError, IndexError):
        return None
