"""The limits on log lines that the settings of a dataflow ask for."""

from collections.abc import Sequence

from dora_systemd.lograte import ALL_NODES, RateLimits, merge_rates
from dora_systemd.settings import Settings
from dora_systemd.settingtable import LOG_RATE_LIMIT
from dora_systemd.suggestions import missing_node


def log_rates(settings: Settings) -> RateLimits:
    """Those that were given by name or for all, below them those of `nodes:` in files.

    Raises DoraSystemdError (BAD_INPUT).
    """
    name = LOG_RATE_LIMIT.name
    nodes = {node: values[name] for node, values in settings.nodes.items() if name in values}
    return merge_rates(nodes, settings[LOG_RATE_LIMIT])


def check_rates(limits: RateLimits, nodes: Sequence[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for a limit of a node that is none of `nodes`."""
    for node in limits:
        if node != ALL_NODES and node not in nodes:
            raise missing_node("cannot limit the lines of", node, nodes)
