"""Checks the settings of a runner against the nodes of its dataflow. Pure."""

from collections.abc import Sequence

from dora_systemd.decisions.cell.options import RunnerOptions, SettingText, runner_setting
from dora_systemd.decisions.descriptor.nodes import Node
from dora_systemd.names import check_known


def check_settings(options: RunnerOptions, nodes: Sequence[Node], is_reload: bool = False) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a node that does not exist, or cannot have a value.

    nodes: all, with modules expanded. is_reload: whether nodes may be gone that a setting outlives.
    """
    ids = [node.id for node in nodes]
    if is_reload:
        there = {"", *ids}
        kept = (one for one in options.settings if one.node in there or not _outlives(one))
        options = options._replace(settings=tuple(kept))
    for key in dict.fromkeys(one.key for one in options.settings):
        options.of_dataflow(key)
        check_known(f"cannot set {key} of", options.by_node(key), ids)
        if check := runner_setting(key).check:
            check(options, nodes)


def _outlives(given: SettingText) -> bool:
    return bool(runner_setting(given.key).outlives_node)
