"""The settings of nodes that say of themselves that they are alive, see sd_notify(3)."""

from operator import or_
from typing import Any

from dora_systemd.decisions.settings.kinds import BOOL, Setting, many_texts
from dora_systemd.decisions.signs.watchdogs import Watchdogs, format_watchdogs, parse_watchdogs

WATCHDOG = Setting[Watchdogs](
    "watchdog",
    many_texts("a time span such as 5s", "[NODE=]TIME", parse_watchdogs, format_watchdogs, or_),
    {},
    "Time in which all nodes, or NODE, must send WATCHDOG=1; one that does not is ended.",
    variable="DORA_WATCHDOG",
    per_node=True,
)
NOTIFY = Setting[bool](
    "notify", BOOL, False, "Give the nodes a notify socket, to tell their STATUS=.", per_node=True
)
SIGN_SETTINGS: tuple[Setting[Any], ...] = (WATCHDOG, NOTIFY)
