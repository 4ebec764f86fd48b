"""What the status page shows of the settings of a dataflow, from its unit. Pure."""

from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.cell.environment import with_changes
from dora_systemd.decisions.cell.limits import LIMITS, Limit, NodeLimits, format_node_limits
from dora_systemd.decisions.cell.options import RunnerOptions
from dora_systemd.values import INFINITY

_LEVEL = ("NoNewPrivileges", "MemoryDenyWriteExecute")
_NETWORK = ("PrivateNetwork", "IPAddressDeny")


def _read_as(limit: Limit) -> str:
    """The property of the limit on D-Bus, see org.freedesktop.systemd1(5)."""
    return "CPUQuotaPerSecUSec" if limit.property == "CPUQuota" else limit.property


PROPERTIES = (*map(_read_as, LIMITS), *_LEVEL, *_NETWORK, "Environment")
"""What fact_values() needs of the unit."""


def fact_values(options: RunnerOptions, unit: Mapping[str, Any]) -> dict[str, Any]:
    """Limits and switches, with the keys of the settings; texts as `doractl set` takes them.

    unit: its PROPERTIES. Raises DoraSystemdError for an Environment= that is not ours.
    """
    environment = dict(one.partition("=")[::2] for one in unit["Environment"] or ())
    now = with_changes(options, environment)
    limits = {one: unit[_read_as(one)] for one in LIMITS}
    nodes = map(_finite, now.node_limits)
    return {
        **{one.key: one.format(value) for one, value in limits.items() if _is_set(value)},
        "node_limit": [format_node_limits(one) for one in nodes if one.limits],
        "hot_reload": now.hot_reload,
        "sandbox": _level(unit),
        "network": _network(unit),
    }


def _finite(one: NodeLimits) -> NodeLimits:
    return one._replace(limits=tuple(pair for pair in one.limits if pair[1] != INFINITY))


def _is_set(value: object) -> bool:
    return isinstance(value, int) and value != INFINITY


def _level(unit: Mapping[str, Any]) -> str:
    """The level of the sandbox, by a property that only it and those above it have."""
    is_on, is_strict = (unit[one] for one in _LEVEL)
    return "strict" if is_on and is_strict else "default" if is_on else "none"


def _network(unit: Mapping[str, Any]) -> str:
    is_private, denied = (unit[one] for one in _NETWORK)
    return "private" if is_private else "loopback" if denied else "host"
