"""File descriptors of the runner: how many it may have, and the end of its input."""

import asyncio
import contextlib
import os
import resource


def raise_file_limit() -> None:
    """Raise this process's soft limit of open files to the hard one: it needs four for each node.

    Call this after the coordinator and the daemon have started: they should inherit the old limit,
    and the daemon raises its own.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


async def wait_eof(fd: int) -> None:
    """Read `fd` until the end of file, and discard the input."""
    loop = asyncio.get_running_loop()
    done = asyncio.Event()

    def read() -> None:
        with contextlib.suppress(BlockingIOError):
            if not os.read(fd, 4096):
                loop.remove_reader(fd)
                done.set()

    loop.add_reader(fd, read)
    await done.wait()
