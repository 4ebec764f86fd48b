"""Spreads a dataflow over its machines, and finds what cannot run on several. Pure.

dora has `deploy: {machine: NAME}` and `deploy: {labels: {KEY: VALUE}}`. A node without either runs
on the head, as does one with the head's own hostname.

With `link: direct` zenoh connects the machines without ssh, on addresses in the settings. dora's
zenoh has no password and no encryption. So zenoh listens only on these addresses, and the units
exchange packets only with these addresses, see decisions/unit/properties.py.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence

from dora_systemd.decisions.cell.launch import is_launched
from dora_systemd.decisions.cell.machines import HEAD, Placed, is_host_name, members_of
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.decisions.cell.owes import owes_of
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import UNEXPANDED, Node, mapping_of
from dora_systemd.decisions.machines.member import (
    DIRECT,
    Machine,
    Member,
    member_of,
    on_head,
    parse_entry,
)
from dora_systemd.decisions.needs.words import needs_of
from dora_systemd.decisions.properties.sandbox import DEFAULT_NETWORK
from dora_systemd.decisions.settings.machines import MACHINES
from dora_systemd.decisions.settings.reload import HOT_RELOAD
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.sandbox import NETWORK
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import did_you_mean
from dora_systemd.values import quoted, scalar_text, shown

Route = Callable[[str, str], str]
"""The address of the head from which it reaches another one, or "" if it cannot. The second one: it
has to be this, unless it is ""."""


def direct_addresses(used: Sequence[Machine], route: Route, source: str) -> tuple[str, ...]:
    """The addresses of head and members, in this order; () if ssh carries the messages.

    used: the members of a dataflow. route: of the head. source: the dataflow file. Raises
    DoraSystemdError (BAD_INPUT) for machines that cannot meet like this.
    """
    direct = [one for one in used if one.link == DIRECT]
    if not direct:
        return ()
    for other in used:
        if other.link != DIRECT:
            reason = f"the link of machine {direct[0].name} is direct, that of {other.name} is not"
            raise _refusal(source, reason, "give all machines of the dataflow the same link")
    found = {"head": _head_address(direct, route, source)}
    found |= {one.name: one.address for one in direct}
    _check_different(found, source)
    return tuple(found.values())


def _head_address(direct: Sequence[Machine], route: Route, source: str) -> str:
    """The one address of the head: its daemon listens on one only."""
    first, *others = direct
    address = _reached_from(first, route, source)
    for other in others:
        if (another := _reached_from(other, route, source)) != address:
            reason = f"the head reaches machine {first.name} from {address}, and {other.name}"
            hint = "give all machines addresses in one network, or the same head_address"
            raise _refusal(source, f"{reason} from {another}", hint)
    return address


def _reached_from(machine: Machine, route: Route, source: str) -> str:
    if found := route(machine.address, machine.head_address):
        return found
    start = f" from {machine.head_address}" if machine.head_address else ""
    reason = f"the head cannot reach address {machine.address} of machine {machine.name}{start}"
    raise _refusal(source, reason, f"see: ip route get {machine.address}")


def _check_different(found: dict[str, str], source: str) -> None:
    seen: dict[str, str] = {}
    for name, address in found.items():
        if address in seen:
            reason = f"{seen[address]} and {name} have the same address {address}"
            raise _refusal(source, reason, "write the address that each machine has of its own")
        seen[address] = name


def place_nodes(
    dataflow: Dataflow, machines: Mapping[str, Machine], hostname: str
) -> tuple[Placed, ...]:
    """The nodes that run on other machines. hostname: of the head.

    Raises DoraSystemdError (BAD_INPUT) with file and node for a machine that is not declared, for
    labels that none has, for a node that can only run on the head, for a machine that is declared
    for this dataflow and runs no node, and for two machines with the same host.
    """
    found = ((node, _machine(node, dataflow, machines, hostname)) for node in dataflow.nodes)
    placed = tuple(Placed(node.id, machine) for node, machine in found if machine)
    for one in placed:
        node = dataflow.node(one.node)
        assert node is not None
        _check_node(node, one.machine, dataflow.source)
    _check_used(placed, machines, hostname, dataflow.source)
    used = [machines[name] for name in members_of(placed)]
    _check_hosts(used, dataflow.source)
    if placed:
        _check_expanded(dataflow)
    return placed


def _machine(node: Node, dataflow: Dataflow, machines: Mapping[str, Machine], hostname: str) -> str:
    """The member of a node, or "" for the head."""
    deploy = mapping_of(node.raw.get("deploy"), dataflow.source, f"node {node.id}: 'deploy'")
    name, labels = deploy.get("machine"), deploy.get("labels")
    if name is not None:
        return _by_name(scalar_text(name), node.id, dataflow.source, machines, hostname)
    what = f"node {node.id}: 'labels' of 'deploy'"
    wanted = mapping_of(labels, dataflow.source, what)
    return _by_labels(wanted, node.id, dataflow.source, machines) if wanted else ""


def _by_name(
    name: str, node: str, source: str, machines: Mapping[str, Machine], hostname: str
) -> str:
    if name in (hostname, hostname.partition(".")[0]):
        return ""
    if name in machines:
        return name
    reason = f"its machine {quoted(name)} is not declared"
    if name == HEAD:
        hint = "leave deploy out: a node without it runs on this machine"
    else:
        hint = f"give --machine {name}=[user@]HOST, or write it below machines: in the settings"
        hint = did_you_mean(name, machines) or hint
    raise _refusal(source, f"node {node}: {reason}", hint)


def _by_labels(
    wanted: Mapping[str, object], node: str, source: str, machines: Mapping[str, Machine]
) -> str:
    """The first machine with these labels."""
    texts = {(key, scalar_text(value)) for key, value in wanted.items()}
    for machine in machines.values():
        if texts <= machine.labels.items():
            return machine.name
    labels = ", ".join(sorted(f"{key}: {value}" for key, value in texts))
    reason = f"node {node}: no machine has the labels {quoted(labels)}"
    raise _refusal(source, reason, "write labels: for one below machines: in the settings")


def _check_node(node: Node, machine: str, source: str) -> None:
    """Refuse what only dora itself, or a build, could start on another machine."""
    reason = ""
    if node.git or node.build:
        reason = "it is built by dora, which happens on one machine only"
    elif not is_launched(node):
        reason = f"dora itself starts it ({node.kind})"
    if reason:
        hint = "leave its deploy out: then it runs on this machine"
        raise _refusal(source, f"node {node.id} cannot run on machine {machine}: {reason}", hint)


def _check_used(
    placed: Sequence[Placed], machines: Mapping[str, Machine], hostname: str, source: str
) -> None:
    used = {*members_of(placed), hostname, hostname.partition(".")[0]}
    for name, machine in machines.items():
        if machine.is_own and name not in used:
            hint = f"write deploy: {{machine: {name}}} at a node, or leave the machine out"
            raise _refusal(source, f"no node runs on machine {name}", hint)


def _check_hosts(machines: Sequence[Machine], source: str) -> None:
    """Refuse two parts on one host, because they would have the same unit."""
    seen: dict[tuple[str, str], str] = {}
    for one in machines:
        key = one.host.destination, one.host.port
        if key in seen:
            reason = f"machines {seen[key]} and {one.name} are the same host {one.host.text}"
            raise _refusal(source, reason, "give all their nodes one deploy.machine")
        seen[key] = one.name


def _check_expanded(dataflow: Dataflow) -> None:
    for node in dataflow.nodes:
        if node.kind in UNEXPANDED:
            reason = f"node {node.id}: a {node.kind} cannot be used on several machines"
            raise _refusal(dataflow.source, reason, "write its nodes into the dataflow")


def _refusal(source: str, reason: str, hint: str) -> DoraSystemdError:
    return bad_input(f"cannot start {shown(source)}: {reason}", hint)


def spread(
    dataflow: Dataflow,
    options: RunnerOptions,
    settings: Settings,
    variables: Mapping[str, str],
    hostname: str,
    route: Route,
) -> tuple[RunnerOptions, tuple[Member, ...]]:
    """Divide a start between machines: the options of the head's runner, and the members.

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
    """Return the options of a member's runner. settings: of its machine, with those of the head.

    Only the head watches owed outputs. Raises DoraSystemdError (BAD_INPUT) as spread().
    """
    own = options.without("owes")
    _check(own, settings)
    return own


def _check(options: RunnerOptions, settings: Settings) -> None:
    for reason, hint in _refused(options, settings):
        message = f"cannot start {shown(options.dataflow)} on several machines: {reason}"
        raise bad_input(message, hint)


def _refused(options: RunnerOptions, settings: Settings) -> Iterator[tuple[str, str]]:
    """Yield what is not possible on several machines, and hints."""
    away = {one.node: one.machine for one in options.placed}
    if options.attached:
        yield "doractl run has one machine only", "use doractl start --attach"
    if options.hot_reload:
        yield "hot reload sees the files of one machine only", f"leave {HOT_RELOAD.flags[0]} out"
    if (network := settings[NETWORK]) != DEFAULT_NETWORK:
        reason = f"the network is {network}, and machines meet in that of the host"
        yield reason, f"leave {NETWORK.flags[0]} out"
    for one in owes_of(options):
        if one.node in away:
            reason = f"node {one.node} is on machine {away[one.node]}, and owes an output"
            yield reason, "leave owes of this node out"
    # The head starts all nodes by dora, and would take a node that waits on a member for late.
    for need in needs_of(options):
        if need.node in away:
            reason = f"node {need.node} is on machine {away[need.node]}, and waits for {need.what}"
            yield reason, "leave needs of this node out"
