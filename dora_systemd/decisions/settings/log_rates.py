"""The setting `log_rate_limit`: how many lines of each node reach the journal."""

from operator import or_

from dora_systemd.decisions.cell.line_rates import HINT, RateLimits, format_rates, parse_rates
from dora_systemd.decisions.settings.kinds import Setting, by_named_node, many_texts

LOG_RATE_LIMIT = Setting[RateLimits](
    "log_rate_limit",
    many_texts("LINES/TIME such as 1000/1s", "[NODE=]LINES/TIME", parse_rates, format_rates, or_),
    {},
    "Log lines per time to keep of each node, or of NODE; the rest is dropped and counted.",
    variable="DORA_LOG_RATE_LIMIT",
    per_node=True,
    by_node=by_named_node("log_rate_limit", format_rates, HINT),
)
RUNNER_SETTINGS = {LOG_RATE_LIMIT.name: LOG_RATE_LIMIT}
