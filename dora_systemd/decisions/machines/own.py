"""Which nodes a machine runs itself, and its options for them. Pure; imports only what is small."""

from dora_systemd.decisions.cell.machines import HEAD, machine_of
from dora_systemd.decisions.cell.options import RunnerOptions


def is_here(options: RunnerOptions, node: str) -> bool:
    """Whether this machine runs the node."""
    return machine_of(options.placed, node) == (options.machine or HEAD)


def own_options(options: RunnerOptions) -> RunnerOptions:
    """The options with what they say of this machine's nodes only."""
    return options._replace(
        node_limits=tuple(one for one in options.node_limits if is_here(options, one.node)),
        node_rights=tuple(one for one in options.node_rights if is_here(options, one.node)),
        needs=tuple(one for one in options.needs if is_here(options, one.node)),
        watchdogs={node: one for node, one in options.watchdogs.items() if is_here(options, node)},
    )
