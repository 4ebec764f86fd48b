"""A port of 127.0.0.1 that leads to the coordinator of a dataflow with a private network.

The dora command can only use ports. A child process listens as long as the command runs: it detects
the end by a pipe that the command and its children have inherited. Only the given users can
connect, and the coordinator requires its token.
"""

import asyncio
import contextlib
import os
import signal
import socket
from collections.abc import Callable, Collection
from pathlib import Path

from dora_systemd.adapters.runner_socket.client import relay
from dora_systemd.adapters.runner_socket.listener import Ends, splice
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.sockets import peer_uid

_LOOPBACK = "127.0.0.1"


def open_port(path: Path, uids: Collection[int], become: Callable[[], None]) -> int:
    """Open the port; it closes when this process, and what it executes or starts, has ended.

    path: of the runner's socket. uids: users that may connect. become: called in the child, to take
    on the user of the dataflow. Raises OSError.
    """
    listener = socket.create_server((_LOOPBACK, 0))
    port: int = listener.getsockname()[1]
    life, held = os.pipe()
    if os.fork() == 0:
        try:
            os.close(held)
            _settle(become)
            asyncio.run(_serve(listener, life, path, frozenset(uids)))
        finally:
            os._exit(0)
    listener.close()
    os.close(life)
    os.set_inheritable(held, True)
    return port


def _settle(become: Callable[[], None]) -> None:
    """Detach from the terminal, because Ctrl+C is for the command, and from its streams."""
    os.setpgid(0, 0)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    null = os.open(os.devnull, os.O_RDWR)
    for number in range(3):
        os.dup2(null, number)
    become()


async def _serve(listener: socket.socket, life: int, path: Path, uids: frozenset[int]) -> None:
    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            if await asyncio.to_thread(_caller, writer) in uids:
                stream, _ = await asyncio.to_thread(relay, path)
                await splice(
                    Ends(reader, writer), Ends(*await asyncio.open_connection(sock=stream))
                )
        except (DoraSystemdError, OSError):
            pass  # the caller sees a closed connection, and reports it
        finally:
            writer.close()

    over = asyncio.Event()
    asyncio.get_running_loop().add_reader(life, over.set)
    server = await asyncio.start_server(talk, sock=listener)
    await over.wait()
    server.close()


def _caller(writer: asyncio.StreamWriter) -> int | None:
    peer, own = (writer.get_extra_info(key) for key in ("peername", "sockname"))
    with contextlib.suppress(TypeError, IndexError):
        return peer_uid(peer[:2], own[:2])
    return None
