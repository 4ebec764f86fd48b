"""Checks the settings of a runner against the nodes of its dataflow. Pure."""

from collections.abc import Sequence

from dora_systemd.decisions.cell.options import RunnerOptions, runner_setting
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.names import check_known


def check_settings(options: RunnerOptions, nodes: Sequence[Node]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that does not exist, or cannot have a value.

    nodes: all, with modules expanded.
    """
    ids = [node.id for node in nodes]
    for key in dict.fromkeys(one.key for one in options.settings):
        options.of_dataflow(key)
        check_known(f"cannot set {key} of", options.by_node(key), ids)
        if check := runner_setting(key).check:
            check(options, nodes)
