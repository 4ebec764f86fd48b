"""The limits on log lines that the settings of a dataflow ask for."""

from dora_systemd.decisions.cell.line_rates import RateLimits, merge_rates
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.table import LOG_RATE_LIMIT


def log_rates(settings: Settings) -> RateLimits:
    """Those that were given by name or for all, below them those of `nodes:` in files.

    Raises DoraSystemdError (BAD_INPUT).
    """
    name = LOG_RATE_LIMIT.name
    nodes = {node: values[name] for node, values in settings.nodes.items() if name in values}
    return merge_rates(nodes, settings[LOG_RATE_LIMIT])
