"""The setting `log_rate_limit`: how many lines of each node reach the journal."""

from collections.abc import Mapping
from operator import or_

from dora_systemd.decisions.cell.line_rates import (
    RateLimits,
    format_rates,
    merge_rates,
    parse_rates,
)
from dora_systemd.decisions.settings.kinds import Setting, many_texts


def _by_node(
    nodes: Mapping[str, RateLimits], given: RateLimits
) -> dict[str, dict[str, RateLimits]]:
    merged = merge_rates(nodes, given)
    return {node: {LOG_RATE_LIMIT.name: {"": limit}} for node, limit in merged.items()}


LOG_RATE_LIMIT = Setting[RateLimits](
    "log_rate_limit",
    many_texts("LINES/TIME such as 1000/1s", "[NODE=]LINES/TIME", parse_rates, format_rates, or_),
    {},
    "Log lines per time to keep of each node, or of NODE; the rest is dropped and counted.",
    variable="DORA_LOG_RATE_LIMIT",
    per_node=True,
    by_node=_by_node,
)
RUNNER_SETTINGS = {LOG_RATE_LIMIT.name: LOG_RATE_LIMIT}
