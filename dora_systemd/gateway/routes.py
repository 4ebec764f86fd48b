"""The paths that the gateway serves."""

from dora_systemd.decisions.gateway.request import PLAIN, Answer, Get, Request, Talk
from dora_systemd.gateway.control.serve import serve_control
from dora_systemd.gateway.live.talk import talk
from dora_systemd.gateway.metrics import answer_metrics
from dora_systemd.gateway.page import page_routes

HEALTH = "/health"


async def answer_health(_request: Request) -> Answer:
    """The reply of dora's own coordinator."""
    return Answer(200, PLAIN, b"ok")


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
