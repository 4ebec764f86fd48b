"""Records messages into the ring: `python record.py SOCKET PACKAGE`, as a node of dora's.

SOCKET hands out the file of the ring, PACKAGE is the directory of dora_systemd. The program runs
with the Python of the nodes, which may be older than the one of the runner. The input "0" is the
first output of the ring. Of dora_systemd it imports only the two modules that write a ring, without
the package around them.
"""

import ctypes
import datetime
import fcntl
import json
import mmap
import os
import re
import socket
import sys
import time
import types
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

PUNCH_HOLE = 3
"""With FALLOC_FL_KEEP_SIZE, see fallocate(2)."""
DISCARDED = rb"Discarding event for input `(\d+)`"
"""What dora prints for each message that its queue has no room for; there is no counter of it."""
PIPE_SIZE = 1 << 20
MOST_META = 16 * 1024
PAUSE_NS = 100_000_000
"""Between two reads of what dora has printed."""
KILLED_FIRST = "1000"
NICE = 10
EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)  # noqa: UP017 - for Python 3.9
MICROSECOND = datetime.timedelta(microseconds=1)
to_json = json.JSONEncoder(default=str).encode


class FileStore:
    """The file of a ring. mapped: its first bytes, which are written often. Raises OSError."""

    def __init__(self, fd: int, mapped: int) -> None:
        self._fd, self._mapped = fd, mmap.mmap(fd, mapped)
        library = ctypes.CDLL(None, use_errno=True)
        self._punch = getattr(library, "fallocate64", None) or library.fallocate

    def write(self, at: int, parts: Sequence[Any]) -> None:
        """Write the parts one after the other."""
        size = sum(map(len, parts))
        if at + size <= len(self._mapped):
            self._mapped[at : at + size] = b"".join(parts)
            return
        done = os.pwritev(self._fd, parts, at)
        if done < size:
            rest = b"".join(map(bytes, parts))[done:]
            self.write(at + done, [rest])

    def read(self, at: int, size: int) -> bytes:
        """Read; what is a hole is 0."""
        return os.pread(self._fd, size, at)

    def punch(self, at: int, size: int) -> None:
        """Make a hole."""
        if self._punch(self._fd, PUNCH_HOLE, ctypes.c_int64(at), ctypes.c_int64(size)):
            raise OSError(ctypes.get_errno(), "cannot give memory back")


class Drops:
    """Counts messages that dora drops before the recorder receives them, from what it prints."""

    def __init__(self) -> None:
        self._reader, writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(writer, False)
        with suppress(OSError):
            fcntl.fcntl(writer, 1031, PIPE_SIZE)  # F_SETPIPE_SZ, which Python has from 3.10 on
        os.dup2(writer, 1)
        self._text, self._read_ns = b"", 0
        self._counts: dict[int, int] = {}

    def take(self, at: int, now_ns: int) -> int:
        """Messages of the output number `at` since the last call. now_ns: CLOCK_BOOTTIME."""
        if now_ns - self._read_ns > PAUSE_NS:
            self._read_ns = now_ns
            self._read()
        return self._counts.pop(at, 0) if self._counts else 0

    def _read(self) -> None:
        with suppress(BlockingIOError):
            self._text += os.read(self._reader, PIPE_SIZE)
            *lines, self._text = self._text.split(b"\n")
            for one in re.findall(DISCARDED, b"\n".join(lines)):
                self._counts[int(one)] = self._counts.get(int(one), 0) + 1


def be_killed_first() -> None:
    """Be killed before others when memory is short."""
    with suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:  # noqa: PTH123
        file.write(KILLED_FIRST)


def has_weight(own: str = "/proc/self/cgroup", groups: str = "/sys/fs/cgroup") -> bool:
    """Whether the cgroup of this process has a share of the CPU time, see cpu.weight."""
    with suppress(OSError), open(own) as file:  # noqa: PTH123
        if found := re.search("^0::(.*)", file.read(), re.MULTILINE):
            return os.path.exists(f"{groups}{found[1]}/cpu.weight")  # noqa: PTH110
    return False


def give_way(is_idle: bool) -> None:
    """Take the CPU time that nobody needs, with all threads; later ones inherit it.

    Not before the imports: where all CPU time is used, these would take minutes. is_idle: by
    SCHED_IDLE, else by SCHED_BATCH and NICE. Without a weight, busy nodes leave nothing to an idle
    process, and neither policy takes the CPU from a node at a wake-up.
    """
    policy, done = os.SCHED_IDLE if is_idle else os.SCHED_BATCH, set[str]()
    while new := {*os.listdir("/proc/self/task")} - done:  # noqa: PTH208 - without pathlib
        for thread in map(int, new):
            with suppress(OSError):
                os.sched_setscheduler(thread, policy, os.sched_param(0))
                if not is_idle:
                    nice = max(os.getpriority(os.PRIO_PROCESS, thread), NICE)
                    os.setpriority(os.PRIO_PROCESS, thread, nice)
        done |= new


def receive_ring(path: str) -> int:
    """Get the file of the ring from the runner. Raises OSError."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.connect(path)
        _, fds, _, _ = socket.recv_fds(connection, 1, 1)
    return fds[0]


def import_writer(package: str) -> Any:
    """Import the writer of dora_systemd without the package, which needs a newer Python."""
    folders = ("", "decisions", "decisions/recorder")
    for folder in folders:
        name = ".".join(["dora_systemd", *folder.split("/")]).rstrip(".")
        module = types.ModuleType(name)
        module.__path__ = [os.path.join(package, folder)]  # noqa: PTH118 - without pathlib
        sys.modules[name] = module
    from dora_systemd.decisions.recorder import writer

    return writer


class Recorder:
    """Writes events of dora into a ring. writer: the module. arrow: pyarrow."""

    def __init__(self, writer: Any, ring: Any, arrow: Any, drops: Any) -> None:
        self._writer, self._ring, self._arrow, self._drops = writer, ring, arrow, drops
        self._schemas: dict[int, tuple[Any, bytes]] = {}

    def put(self, at: int, value: Any, metadata: Any) -> None:
        """Copy one message. metadata: dora's, with the time of the message."""
        schema, data = self._serialized(at, value)
        now_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        times = time.time_ns(), now_ns, _sent(metadata)
        message = self._writer.Message(schema, _meta(metadata), data, *times)
        self._ring.put(at, message, self._drops.take(at, now_ns))

    def _serialized(self, at: int, value: Any) -> tuple[bytes, Any]:
        if self._arrow.types.is_dictionary(value.type):
            value = value.dictionary_decode()  # else its values would be a message of their own
        batch = self._arrow.RecordBatch.from_arrays([value], ["value"])
        known = self._schemas.get(at)
        if known is None or not known[0].equals(batch.schema, check_metadata=True):
            known = batch.schema, batch.schema.serialize().to_pybytes()
            self._schemas[at] = known
        return known[1], batch.serialize()


def _sent(metadata: Any) -> int:
    sent = (metadata or {}).get("timestamp")
    return (sent - EPOCH) // MICROSECOND * 1000 if isinstance(sent, datetime.datetime) else 0


def _meta(metadata: Any) -> bytes:
    if not metadata or (len(metadata) == 1 and "timestamp" in metadata):
        return b"{}"
    own = {key: value for key, value in metadata.items() if key != "timestamp"}
    data = to_json(own).encode(errors="replace")
    return data if len(data) <= MOST_META else b"{}"


def record(node: Any, recorder: Recorder) -> None:
    """Record until the node is stopped, or one of its inputs ends.

    The runner then starts another recorder for the inputs that are left.
    """
    # Without a timeout, for which dora would wake a thread at each message.
    while (event := node.next()) is not None:
        kind = event["type"]
        if kind == "INPUT":
            recorder.put(int(event["id"]), event["value"], event["metadata"])
        elif kind in ("STOP", "INPUT_CLOSED"):
            return
        del event  # its memory is that of the node that has sent it


def main(path: str, package: str) -> None:
    """Open the ring, and run as a node."""
    be_killed_first()
    writer, drops = import_writer(package), Drops()
    fd = receive_ring(path)
    header = writer.parse_header(os.pread(fd, writer.ALIGN, 0))
    ring = writer.Writer(FileStore(fd, writer.tape_at(header, 0)), mmap.PAGESIZE)
    import pyarrow
    from dora import Node

    node = Node()
    give_way(has_weight())
    record(node, Recorder(writer, ring, pyarrow, drops))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2])
