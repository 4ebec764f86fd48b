"""Turns settings into restart policies, for the runner and for systemd."""

from collections.abc import Iterator, Mapping

from dora_systemd.decisions.cell.restarts import DEFAULT, RestartPolicy, with_values
from dora_systemd.decisions.settings.resolve import DEFAULT_SOURCE, Settings
from dora_systemd.decisions.settings.restarts import (
    MAX_RESTART_DELAY,
    MAX_RESTARTS,
    RESTART_DELAY,
    RESTART_POLICY,
    RESTART_SETTINGS,
    RESTART_WINDOW,
)

_FIELDS: Mapping[str, str] = {
    RESTART_POLICY.name: "policy",
    MAX_RESTARTS.name: "max_restarts",
    RESTART_WINDOW.name: "window",
    RESTART_DELAY.name: "delay",
    MAX_RESTART_DELAY.name: "max_delay",
}


def restart_policy(settings: Settings) -> RestartPolicy:
    """The policy of the dataflow, and of its nodes without one."""
    values = {_FIELDS[one.name]: settings[one] for one in RESTART_SETTINGS if one.name in _FIELDS}
    return with_values(DEFAULT, values)


def node_policies(settings: Settings) -> tuple[tuple[str, RestartPolicy], ...]:
    """The policies of nodes in settings files, based on that of the dataflow."""
    base = restart_policy(settings)
    found = []
    for node, given in settings.nodes.items():
        values = {_FIELDS[name]: value for name, value in given.items() if name in _FIELDS}
        if values:
            found.append((node, with_values(base, values)))
    return tuple(found)


def restart_warnings(settings: Settings) -> Iterator[str]:
    """A warning for each restart setting that has no effect because nothing restarts."""
    policies = [settings[RESTART_POLICY], *(policy.policy for _, policy in node_policies(settings))]
    if any(policy != "no" for policy in policies):
        return
    for setting in RESTART_SETTINGS:
        is_given = settings.source(setting) != DEFAULT_SOURCE
        if setting.name in _FIELDS and setting is not RESTART_POLICY and is_given:
            yield f"{setting.flags[0]} has no effect without {RESTART_POLICY.flags[0]}"
