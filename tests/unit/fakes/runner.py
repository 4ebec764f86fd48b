"""The socket of a runner that does what it is asked."""

import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any


@contextmanager
def fake_runner(directory: Path, *done: str, **more: object) -> Iterator[list[dict[str, Any]]]:
    """A runner with its socket in `directory`, which reports to have done that: its requests.

    more: keys of each answer.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / "runner.sock"
    asked: list[dict[str, Any]] = []

    def serve() -> None:
        with suppress(OSError):  # the end of the socket
            while True:
                stream, _ = listener.accept()
                with stream, stream.makefile("rb") as lines:
                    asked.append(json.loads(lines.readline()))
                    stream.sendall(json.dumps({"done": done, **more}).encode() + b"\n")

    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield asked
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()
            path.unlink()
