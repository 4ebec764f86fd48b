"""The status page: static files that load nothing from other servers."""

from functools import cache
from pathlib import Path

from dora_systemd.decisions.gateway.request import Answer, Get, Request

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
    """One route for each file of the page."""
    names = sorted(path.name for path in DIRECTORY.iterdir() if path.suffix in TYPES)
    return {"/" if name == INDEX else f"{PREFIX}{name}": _answer_file for name in names}


async def _answer_file(request: Request) -> Answer:
    name = request.path.removeprefix(PREFIX).strip("/") or INDEX
    return Answer(200, TYPES[Path(name).suffix], _read(name), HEADERS)


@cache
def _read(name: str) -> bytes:
    return (DIRECTORY / name).read_bytes()
