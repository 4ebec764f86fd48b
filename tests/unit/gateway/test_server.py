"""What all connections of the gateway share."""

import asyncio
import os
import socket
import threading
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


def test_a_bundle_is_sent_in_parts(tmp_path: Path) -> None:
    """By the same door as the page."""
    place = tmp_path / "state/dora-systemd/bundles/robot"
    place.mkdir(parents=True)
    data = bytes(range(256)) * 20_000
    (place / BUNDLE).write_bytes(data)

    async def serve() -> list[bytes]:
        listener = socket.create_server(("127.0.0.1", 0))
        gateway = Gateway(ScopeIn(True, os.getuid(), tmp_path), "token")
        running = asyncio.ensure_future(gateway.run([listener], 60))
        found = []
        paths = "/bundles/robot/x.tar", "/bundles/", "/pictures/", "/pictures/x/y"
        for path in (f"/bundles/robot/{BUNDLE}", *paths):
            reader, writer = await asyncio.open_connection(*listener.getsockname())
            writer.write(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            found.append(await reader.read())
            writer.close()
            await writer.wait_closed()
        running.cancel()
        await asyncio.wait({running})
        listener.close()
        return found

    whole, *others = asyncio.run(serve())
    head, _, body = whole.partition(b"\r\n\r\n")
    assert body == data
    assert head.startswith(b"HTTP/1.1 200")
    for line in (f"Content-Length: {len(data)}", f'attachment; filename="{BUNDLE}"'):
        assert line.encode() in head
    assert b"default-src 'none'" in head
    assert all(one.startswith(b"HTTP/1.1 404") for one in others)
