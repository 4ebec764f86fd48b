"""Spreads a dataflow over its machines: a part of the plan of a start. Pure."""

from collections.abc import Iterator, Mapping

from dora_systemd.decisions.cell.machines import is_host_name, members_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.machines.direct import Route, direct_addresses
from dora_systemd.decisions.machines.entry import parse_entry
from dora_systemd.decisions.machines.member import Member, member_of, on_head
from dora_systemd.decisions.machines.placement import place_nodes
from dora_systemd.decisions.properties.sandbox import DEFAULT_NETWORK
from dora_systemd.decisions.settings.machines import MACHINES
from dora_systemd.decisions.settings.reload import HOT_RELOAD
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.sandbox import NETWORK
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import shown


def spread(
    dataflow: Dataflow,
    options: RunnerOptions,
    settings: Settings,
    variables: Mapping[str, str],
    hostname: str,
    route: Route,
) -> tuple[RunnerOptions, tuple[Member, ...]]:
    """The options of the head's runner, and what the members are told.

    variables: of --env and environment files. hostname, route: of the head. Raises
    DoraSystemdError (BAD_INPUT) for a placement that does not work, and for what works on one
    machine only.
    """
    source = settings.source(MACHINES)
    machines = {
        name: parse_entry(name, declared, source, options.dataflow)
        for name, declared in settings[MACHINES].items()
    }
    placed = place_nodes(dataflow, machines, hostname)
    if not placed:
        return options, ()
    whole = options._replace(placed=placed, head=hostname if is_host_name(hostname) else "")
    _check(whole, settings)
    used = [machines[name] for name in members_of(placed)]
    whole = whole._replace(addresses=direct_addresses(used, route, options.dataflow))
    told = tuple(member_of(one, whole, settings, variables) for one in used)
    return on_head(whole), told


def part(options: RunnerOptions, settings: Settings) -> RunnerOptions:
    """The options of a member's runner. settings: those of its machine, with what the head tells.

    The head looks after owed outputs. Raises DoraSystemdError (BAD_INPUT) as spread().
    """
    own = options._replace(owes=())
    _check(own, settings)
    return own


def _check(options: RunnerOptions, settings: Settings) -> None:
    for reason, hint in _refused(options, settings):
        message = f"cannot start {shown(options.dataflow)} on several machines: {reason}"
        raise DoraSystemdError(message, hint, ExitCode.BAD_INPUT)


def _refused(options: RunnerOptions, settings: Settings) -> Iterator[tuple[str, str]]:
    """What is not possible on several machines, and a hint."""
    away = {one.node: one.machine for one in options.placed}
    if options.attached:
        yield "doractl run has one machine only", "use doractl start --attach"
    if options.hot_reload:
        yield "hot reload sees the files of one machine only", f"leave {HOT_RELOAD.flags[0]} out"
    if (network := settings[NETWORK]) != DEFAULT_NETWORK:
        reason = f"the network is {network}, and machines meet in that of the host"
        yield reason, f"leave {NETWORK.flags[0]} out"
    for one in options.owes:
        if one.node in away:
            reason = f"node {one.node} is on machine {away[one.node]}, and owes an output"
            yield reason, "leave owes of this node out"
    # The head asks dora for the nodes, and would take one that waits elsewhere for late.
    for need in options.needs:
        if need.node in away:
            reason = f"node {need.node} is on machine {away[need.node]}, and waits for {need.path}"
            yield reason, "leave needs of this node out"
