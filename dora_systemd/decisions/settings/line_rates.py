"""The rate limits of log lines from settings."""

from dora_systemd.decisions.cell.line_rates import RateLimits, merge_rates
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.table import LOG_RATE_LIMIT


def log_rates(settings: Settings) -> RateLimits:
    """The limits of `log_rate_limit`, which take precedence over those of `nodes:` in files.

    Raises DoraSystemdError (BAD_INPUT).
    """
    name = LOG_RATE_LIMIT.name
    nodes = {node: values[name] for node, values in settings.nodes.items() if name in values}
    return merge_rates(nodes, settings[LOG_RATE_LIMIT])
