"""What all connections of the gateway share."""

import asyncio
import os
import socket
import threading
from collections.abc import Sequence
from pathlib import Path

from dora_systemd.gateway.server import Gateway
from dora_systemd.scope import Scope
from tests.unit.fakes.manager import ScopeIn

BUNDLE = "robot-20261127T041500Z-requested.tar"


def test_slow_actions_leave_room_for_others() -> None:
    """Each of these waits for all others, as a page waits while dataflows stop."""
    together = threading.Barrier(40)

    async def serve() -> None:
        await Gateway(Scope(True, 0), "token").run([], 0.0)
        waits = (asyncio.to_thread(together.wait, 20) for _ in range(together.parties))
        assert len(set(await asyncio.gather(*waits))) == together.parties

    asyncio.run(serve())


def replies(root: Path, requests: Sequence[bytes]) -> list[bytes]:
    """What a gateway sends for each of these, on a connection each."""

    async def serve() -> list[bytes]:
        listener = socket.create_server(("127.0.0.1", 0))
        gateway = Gateway(ScopeIn(True, os.getuid(), root), "token")
        running = asyncio.ensure_future(gateway.run([listener], 60))
        found = []
        for request in requests:
            reader, writer = await asyncio.open_connection(*listener.getsockname())
            writer.write(request)
            found.append(await reader.read())
            writer.close()
            await writer.wait_closed()
        running.cancel()
        await asyncio.wait({running})
        listener.close()
        return found

    return asyncio.run(serve())


def test_each_request_has_one_answer(tmp_path: Path) -> None:
    """Some versions of websockets close a connection without a word, or answer by themselves."""
    wrong = b"GET /health HTTP/1.0\r\n\r\n", b"hello\r\n\r\n", b"HEAD / HTTP/1.1\r\n\r\n"
    long = b"GET /" + b"x" * 20_000 + b" HTTP/1.1\r\n\r\n"
    for reply in replies(tmp_path, (*wrong, long)):
        assert reply.startswith(b"HTTP/1.1 4")
        assert reply.count(b"HTTP/1.1 4") == 1


def test_a_bundle_is_sent_in_parts(tmp_path: Path) -> None:
    """By the same door as the page."""
    place = tmp_path / "state/dora-systemd/bundles/robot"
    place.mkdir(parents=True)
    data = bytes(range(256)) * 20_000
    (place / BUNDLE).write_bytes(data)

    paths = f"/bundles/robot/{BUNDLE}", "/bundles/robot/x.tar", "/bundles/", "/pictures/"
    asked = [
        f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
        for path in (*paths, "/pictures/x/y")
    ]
    whole, *others = replies(tmp_path, asked)
    head, _, body = whole.partition(b"\r\n\r\n")
    assert body == data
    assert head.startswith(b"HTTP/1.1 200")
    for line in (f"Content-Length: {len(data)}", f'attachment; filename="{BUNDLE}"'):
        assert line.encode() in head
    assert b"default-src 'none'" in head
    assert all(one.startswith(b"HTTP/1.1 404") for one in others)
