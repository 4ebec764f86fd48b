"""The paths that the gateway serves."""

import asyncio

from dora_systemd import __version__
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.gateway.request import PLAIN, Answer, Get, Request, Talk
from dora_systemd.decisions.views.prometheus import CONTENT_TYPE, format_metrics
from dora_systemd.gateway.control.serve import serve_control
from dora_systemd.gateway.live.talk import talk
from dora_systemd.gateway.page import page_routes
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.snapshot import read_snapshot

HEALTH = "/health"


async def answer_health(_request: Request) -> Answer:
    """The reply of dora's own coordinator."""
    return Answer(200, PLAIN, b"ok")


async def answer_metrics(request: Request) -> Answer:
    """One snapshot of all dataflows for Prometheus. Raises DoraSystemdError without systemd."""
    text = await asyncio.to_thread(_metrics, request.scope)
    return Answer(200, CONTENT_TYPE, text.encode("utf-8", "replace"))


def _metrics(scope: Scope) -> str:
    return format_metrics(read_snapshot(Bus(scope, for_reading=True), scope), __version__)


GET: dict[str, Get] = {
    HEALTH: answer_health,
    "/metrics": answer_metrics,
    **page_routes(),
}
SOCKETS: dict[str, Talk] = {
    "/api/control": serve_control,
    "/api/live": talk,
}

OPEN_TO_ALL = frozenset({HEALTH})
"""Paths that every local user may read; they reveal nothing."""
