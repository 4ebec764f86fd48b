"""/metrics: all dataflows of the scope for Prometheus."""

import asyncio

from dora_systemd import __version__
from dora_systemd.bus import Bus
from dora_systemd.gatewayrequest import Answer, Request
from dora_systemd.managersnapshot import read_snapshot
from dora_systemd.metrics import CONTENT_TYPE, format_metrics
from dora_systemd.scope import Scope


async def answer_metrics(request: Request) -> Answer:
    """One reading. Raises DoraSystemdError where systemd is out of reach."""
    text = await asyncio.to_thread(_read, request.scope)
    return Answer(200, CONTENT_TYPE, text.encode("utf-8", "replace"))


def _read(scope: Scope) -> str:
    return format_metrics(read_snapshot(Bus(scope, for_reading=True), scope), __version__)
