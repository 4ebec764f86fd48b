"""A port of 127.0.0.1 that leads to the coordinator of a dataflow whose network is its own.

The stock dora command speaks to ports only. A child process listens for as long as the command
lives: it knows by a pipe that the command and all that it started has inherited. Only the callers'
own users get through, and the coordinator asks each of them for its token.
"""

import asyncio
import contextlib
import os
import signal
import socket
from collections.abc import Callable, Collection
from pathlib import Path

from dora_systemd.adapters.runner_socket.client import relay
from dora_systemd.adapters.runner_socket.splice import Ends, splice
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.socket_table import peer_uid

_LOOPBACK = "127.0.0.1"


def open_port(path: Path, uids: Collection[int], become: Callable[[], None]) -> int:
    """The port; it is closed when this process and those that it becomes or starts have ended.

    path: of the runner's socket. uids: who may connect. become: called in the child, to be no
    more than the user of the dataflow. Raises OSError.
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
    """Out of the terminal's reach, Ctrl+C is for the command; and without its streams."""
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
            pass  # the caller sees its connection closed, and says so
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
