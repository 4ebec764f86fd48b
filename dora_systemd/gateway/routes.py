"""What the gateway answers: one line for each path."""

from dora_systemd.decisions.gateway.request import PLAIN, Answer, Get, Request, Talk
from dora_systemd.gateway.control.serve import serve_control
from dora_systemd.gateway.live.talk import talk
from dora_systemd.gateway.metrics import answer_metrics
from dora_systemd.gateway.page import page_routes

HEALTH = "/health"


async def answer_health(_request: Request) -> Answer:
    """What dora's own coordinator says there."""
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
"""What every user of the machine may ask; it tells nothing."""
