"""/metrics: all dataflows of the scope for Prometheus."""

import asyncio

from dora_systemd import __version__
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.gateway.request import Answer, Request
from dora_systemd.decisions.views.prometheus import CONTENT_TYPE, format_metrics
from dora_systemd.scope import Scope
from dora_systemd.verbs.facts.snapshot import read_snapshot


async def answer_metrics(request: Request) -> Answer:
    """One snapshot. Raises DoraSystemdError if systemd is unreachable."""
    text = await asyncio.to_thread(_read, request.scope)
    return Answer(200, CONTENT_TYPE, text.encode("utf-8", "replace"))


def _read(scope: Scope) -> str:
    return format_metrics(read_snapshot(Bus(scope, for_reading=True), scope), __version__)
