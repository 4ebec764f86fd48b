"""Which node runs on which machine, and what cannot run on several. Pure.

dora has `deploy: {machine: NAME}` and `deploy: {labels: {KEY: VALUE}}`. A node without either runs
on the head, as does one with the head's own hostname.
"""

from collections.abc import Mapping, Sequence

from dora_systemd.decisions.cell.launch import is_launched
from dora_systemd.decisions.cell.machines import HEAD, Placed, members_of
from dora_systemd.decisions.descriptor.dataflow import Dataflow
from dora_systemd.decisions.descriptor.nodes import UNEXPANDED, Node, mapping_of
from dora_systemd.decisions.machines.entry import Machine
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.names import did_you_mean
from dora_systemd.values import quoted, scalar_text, shown


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
    """Two parts of a dataflow on one host would have the same unit."""
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
    return DoraSystemdError(f"cannot start {shown(source)}: {reason}", hint, ExitCode.BAD_INPUT)
