"""pystemd for a FakeManager: our own Bus speaks to it as to the real one.

It knows the calls of the gateway's doers, and no types: a word is a value of its signature.
"""

import json
import os
import re
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from dora_systemd.decisions.logs.journal_events import FORGOTTEN
from tests.unit.fakes.libraries import install
from tests.unit.fakes.manager import FakeManager
from tests.unit.fakes.programs import make_program

JOBS = ("StartUnit", "StopUnit", "RestartUnit")


class Message:
    """A signal, or the answer to a call."""

    def __init__(self, member: str = "", body: Any = None) -> None:
        self.member, self.body = member, body

    def is_empty(self) -> bool:
        return not self.member

    def is_signal(self, _interface: bytes, member: bytes) -> bool:
        return member.decode() == self.member

    def process_reply(self, _wanted: bool) -> None:
        """Nobody waits for it."""


class FakeSystemd:
    """is_slow: jobs end with the first kill, or finish(). lives: InvocationID, one by one.

    refuses: an error that it answers each call with. refused: the same by method. timeouts: for an
    answer, of each connection.
    """

    def __init__(self, manager: FakeManager) -> None:
        self.manager = manager
        self.is_slow = False
        self.refuses: Exception | None = None
        self.refused: dict[str, Exception] = {}
        self.timeouts: list[str] = []
        self.lives: list[Callable[[], str]] = []
        self.connections: list[Connection] = []
        self._waiting: list[tuple[str, str]] = []
        self._lock = threading.RLock()

    def open(self, *_: object, **__: object) -> "Connection":
        with self._lock:
            self.connections.append(Connection(self))
            return self.connections[-1]

    def call(self, path: bytes, method: str, words: list[str]) -> Any:
        if error := self.refused.get(method, self.refuses):
            raise error
        with self._lock:
            if method in JOBS:
                return self._job(method, words[0])
            if method == "KillUnit":
                self.manager.kill(words[0], int(words[2]), words[1])
                self.finish()
            return self._answer(path, method, words)

    def _answer(self, path: bytes, method: str, words: list[str]) -> Any:
        if method == "ListUnitsByPatterns":
            found = self.manager.list_units(words[0])
            return [[one.unit, one.description, *one[1:4], "", "/", 0, one.job] for one in found]
        if method == "Get":
            return self._get(path.rpartition(b"/")[2].decode(), words[1])
        if method == "ThawUnit":
            self.manager.thaw(words[0])
        if method == "ResetFailedUnit":
            self.manager.reset_failed(words[0])
        if method == "RefUnit":
            self.manager.hold(words[0])
        if method == "Reload":
            self.manager.reload()
        return None

    def _get(self, part: str, name: str) -> Any:
        if name == "UnitPath":
            return self.manager.unit_path()
        if name == "InvocationID" and self.lives:
            return self.lives.pop(0)()
        unit = re.sub("_([0-9a-f]{2})", lambda code: chr(int(code[1], 16)), part)
        return self.manager.read(unit, [name])[name]

    def _job(self, method: str, unit: str) -> str:
        job = f"/job/{method}/{unit}"
        result = self.manager.run_jobs(method, [unit])[unit]
        self._waiting.append((job, result))
        if not self.is_slow:
            self._end_jobs()
        return job

    def finish(self) -> None:
        """All jobs end, those that are yet to come as well."""
        self.is_slow = False
        self._end_jobs()

    def _end_jobs(self) -> None:
        with self._lock:  # a connection that is closed meanwhile must not hide the next one
            for job, result in self._waiting:
                for one in tuple(self.connections):
                    one.tell(Message("JobRemoved", [0, job, "", result]))
            self._waiting.clear()


class Connection:
    """A DBusAddress of pystemd."""

    def __init__(self, systemd: FakeSystemd) -> None:
        self._systemd = systemd
        self._messages: list[Message] = []
        self._fd = os.eventfd(1)

    def open(self) -> None:
        """The other side has spoken already: its descriptor is readable."""
        self._systemd.timeouts.append(os.environ["SYSTEMD_BUS_TIMEOUT"])

    def get_fd(self) -> int:
        return self._fd

    def close(self) -> None:
        with self._systemd._lock:
            if self in self._systemd.connections:
                self._systemd.connections.remove(self)
                os.close(self._fd)

    def call_method(
        self, _service: bytes, path: bytes, _interface: bytes, method: bytes, words: list[Any]
    ) -> Message:
        values = [word for kind, word in words if kind not in (-1, ord("a"), ord("r"))]
        texts = [os.fsdecode(one) if isinstance(one, bytes) else str(one) for one in values]
        return Message("", self._systemd.call(path, method.decode(), texts))

    def match_signal(self, *_: object) -> None:
        """All signals come anyway."""

    def tell(self, message: Message) -> None:
        if self in self._systemd.connections:
            self._messages.append(message)
            os.eventfd_write(self._fd, 1)

    def process(self) -> Message:
        if self._messages:
            return self._messages.pop(0)
        os.set_blocking(self._fd, False)
        with suppress(BlockingIOError):
            os.eventfd_read(self._fd)
        return self._messages.pop(0) if self._messages else Message()


def fake_systemd(patch: pytest.MonkeyPatch, manager: FakeManager) -> FakeSystemd:
    """From now on every Bus leads to `manager`."""
    systemd = FakeSystemd(manager)
    install(patch, "pystemd.dbuslib", DBusAddress=systemd.open)
    # It keeps what it has found, as Python keeps every module: what comes of the fake goes again.
    ours = "dora_systemd.adapters.bus.library"
    patch.setitem(sys.modules, ours, sys.modules.get(ours, ModuleType(ours)))
    patch.delitem(sys.modules, ours)
    return systemd


def fake_journalctl(
    patch: pytest.MonkeyPatch, directory: Path, records: bytes | Iterable[Mapping[str, Any]]
) -> Path:
    """From now on journalctl prints `records`; the file with the arguments of each call.

    It does not know matches, and no dataflow has been forgotten.
    """
    if not isinstance(records, bytes):
        records = "".join(json.dumps(one) + "\n" for one in records).encode()
    (directory / "records").write_bytes(records)
    calls = directory / "calls"
    printed = f'case "$*" in *{FORGOTTEN}*) ;; *) cat {directory}/records;; esac'
    make_program(directory / "journalctl", f'echo "$@" >> {calls}\n{printed}')
    patch.setenv("PATH", f"{directory}:{os.environ['PATH']}")
    return calls
