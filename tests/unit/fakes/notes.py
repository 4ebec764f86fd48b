"""What this process writes to the journal by a socket, which journald need not be there to take."""

import socket

import pytest

from dora_systemd.adapters.journal.note import JOURNAL_SOCKET
from dora_systemd.decisions.logs.lines import ExportReader


class Notes:
    """The records that are sent while `patch` is in effect."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self._sent: list[bytes] = []

        def send(_socket: socket.socket, entry: bytes, path: str) -> int:
            assert path == JOURNAL_SOCKET
            self._sent.append(entry)
            return len(entry)

        patch.setattr(socket.socket, "sendto", send)

    @property
    def records(self) -> list[dict[str, str]]:
        """The fields of each, the oldest first."""
        entries = ExportReader().feed(b"".join(one + b"\n" for one in self._sent))
        return [{name: value.decode() for name, value in one.items()} for one in entries]

    def found(self, *names: str) -> list[tuple[str, ...]]:
        """These fields of each record, "" for one that it has not."""
        return [tuple(one.get(name, "") for name in names) for one in self.records]
