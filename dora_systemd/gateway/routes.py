"""The paths that the gateway serves; those of the status page are static files."""

import asyncio
from functools import cache, partial
from pathlib import Path

from dora_systemd import __version__
from dora_systemd.adapters.bus.systemd import Bus
from dora_systemd.decisions.gateway.request import PLAIN, Answer, Get, Request, Talk, text_answer
from dora_systemd.decisions.views.prometheus import CONTENT_TYPE, format_metrics
from dora_systemd.gateway.control.serve import serve_control
from dora_systemd.gateway.live.page import talk
from dora_systemd.names import is_uuid
from dora_systemd.scope import Scope
from dora_systemd.verbs.top import read_snapshot

DIRECTORY = Path(__file__).parent / "static"
PREFIX = "/page/"
INDEX = "index.html"

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Frame-Options": "DENY",
}


def page_routes() -> dict[str, Get]:
    """Return a route for each file of the page."""
    found = (path for path in DIRECTORY.rglob("*") if path.suffix in TYPES)
    names = sorted(str(path.relative_to(DIRECTORY)) for path in found)
    return {"/" if name == INDEX else f"{PREFIX}{name}": _answer_file for name in names}


async def _answer_file(request: Request) -> Answer:
    name = request.path.removeprefix(PREFIX).strip("/") or INDEX
    return Answer(200, TYPES[Path(name).suffix], _read(name), HEADERS)


@cache
def _read(name: str) -> bytes:
    return (DIRECTORY / name).read_bytes()


HEALTH = "/health"


async def answer_health(_request: Request) -> Answer:
    """The reply of dora's own coordinator."""
    return Answer(200, PLAIN, b"ok")


async def answer_metrics(request: Request) -> Answer:
    """Answer with the metrics of all dataflows. Raises DoraSystemdError without systemd."""
    text = await asyncio.to_thread(_metrics, request.scope)
    return Answer(200, CONTENT_TYPE, text.encode("utf-8", "replace"))


def _metrics(scope: Scope) -> str:
    return format_metrics(read_snapshot(Bus(scope, for_reading=True), scope), __version__)


GET: dict[str, Get] = {
    HEALTH: answer_health,
    "/metrics": answer_metrics,
    **page_routes(),
}
BUNDLES = "/bundles/"


async def answer_bundle(request: Request) -> Answer:
    """Answer with a bundle: /bundles/NAME/BUNDLE. Raises DoraSystemdError."""
    # Imported late: few download one, and its imports are memory.
    from dora_systemd.verbs.bundles.listing import find_bundle, read_parts

    name, _, ident = request.path.removeprefix(BUNDLES).partition("/")
    found = await asyncio.to_thread(find_bundle, request.scope, name, ident)
    if found is None:
        return text_answer(404, "there is no such bundle")
    headers = {**HEADERS, "Content-Disposition": f'attachment; filename="{found.id}"'}
    return Answer(
        200, "application/x-tar", b"", headers, partial(next, read_parts(found), b""), found.size
    )


PICTURES = "/pictures/"


async def answer_pictures(request: Request) -> Answer:
    """Answer with the last pictures of a dataflow: /pictures/UUID. Raises DoraSystemdError."""
    # Imported late: only a dataflow on a page needs it, and its imports are memory.
    from dora_systemd.gateway.live.pictures import pictures_body

    uuid = request.path.removeprefix(PICTURES)
    if not is_uuid(uuid):
        return text_answer(404, "there is nothing here")
    body = await asyncio.to_thread(pictures_body, request.scope, uuid)
    return Answer(200, "application/octet-stream", body, HEADERS)


BELOW: dict[str, Get] = {BUNDLES: answer_bundle, PICTURES: answer_pictures}
"""The routes of all paths that begin so."""


def find_route(path: str) -> Get | None:
    """The route of a path, None if there is nothing."""
    below = (route for prefix, route in BELOW.items() if path.startswith(prefix))
    return GET.get(path) or next(below, None)


SOCKETS: dict[str, Talk] = {
    "/api/control": serve_control,
    "/api/live": talk,
}

OPEN_TO_ALL = frozenset({HEALTH})
"""Paths that every local user may read; they reveal nothing."""
