"""Records when messages of nodes arrive: `python listen.py FILE SECONDS`, as a node of dora's.

FILE is the file of times of dora_systemd/decisions/owes/probe.py, and SECONDS the time between two
beats at most. The input "0" is the first owed output. The program runs with the Python of the
nodes, so it imports nothing of dora_systemd, and no other package than dora.
"""

import mmap
import sys
import time
import types
from collections.abc import Callable
from typing import Any


class Ignored(type):
    """The class of a class whose functions all do nothing."""

    def __getattr__(cls, name: str) -> Callable[..., None]:
        """Return a function that ignores its arguments."""
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *_, **__: None


def leave_out_arrow() -> None:
    """Replace pyarrow by a stub for dora, because the probe does not read the data.

    The real pyarrow takes 50 MB, and would copy each message.
    """
    arrow = types.ModuleType("pyarrow")
    vars(arrow)["__getattr__"] = lambda name: Ignored(name, (), {})
    sys.modules["pyarrow"] = arrow


def listen(node: Any, times: memoryview, seconds: float) -> None:
    """Record beats and messages until the node is stopped, or one of its inputs ends.

    The runner then starts another probe for the inputs that are left.
    """
    while True:
        began = time.monotonic()
        event = node.next(timeout=seconds)
        now = time.monotonic_ns() // 1000
        times[0] = now
        kind = "" if event is None else event["type"]
        if kind == "INPUT":
            times[1 + int(event["id"])] = now
        elif kind in ("STOP", "INPUT_CLOSED"):
            return
        elif time.monotonic() - began < seconds / 2:
            # Some other event than a timeout came early: do not call next() again at once.
            time.sleep(seconds / 2)


def main(path: str, seconds: float) -> None:
    """Open the file, and run as a node."""
    with open(path, "r+b") as file:  # noqa: PTH123 - without pathlib, which is more memory
        times = memoryview(mmap.mmap(file.fileno(), 0)).cast("Q")
    leave_out_arrow()
    from dora import Node

    listen(Node(), times, seconds)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
