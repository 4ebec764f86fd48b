"""Finds the ends by SIGKILL that were requested, as by `doractl stop --now`: systemd calls the unit
failed, and what runs after a failure writes `dataflow-failed`, as after any other kill. Pure.
"""

from collections.abc import Mapping
from typing import Any

from dora_systemd.decisions.life.causes import BY_SIGKILL
from dora_systemd.decisions.logs.journal_events import STOP_ASKED
from dora_systemd.decisions.logs.query import PROCESS_EXITED, UNIT_STARTING, UNIT_STOPPING


class Kills:
    """Reads records, newest first, with those of kill_matches() and the events of the dataflow.

    requested: the INVOCATION_ID of the lives whose end was requested before the process ended.
    """

    def __init__(self) -> None:
        self.requested: set[str] = set()
        self._failed: dict[str, str] = {}  # the UUIDs of lives that SIGKILL has ended
        self._running: dict[str, str] = {}  # those of which the older records are from before that

    def read(self, record: Mapping[str, Any]) -> None:
        """Read the next record."""
        event, uuid = record.get("DORA_EVENT"), str(record.get("DORA_DATAFLOW", ""))
        if event == "dataflow-failed" and record.get("DORA_REASON") == BY_SIGKILL:
            self._failed[str(record.get("_SYSTEMD_INVOCATION_ID", ""))] = uuid
        elif event == STOP_ASKED:
            self.requested |= {life for life, own in self._running.items() if own == uuid != ""}
        elif not event:  # a node can write any field, but only into events
            self._read_of_systemd(str(record.get("MESSAGE_ID", "")), life_of(record))

    def _read_of_systemd(self, kind: str, life: str) -> None:
        if kind == PROCESS_EXITED and life in self._failed:
            self._running[life] = self._failed.pop(life)
        elif kind == UNIT_STOPPING and life in self._running:
            self.requested.add(life)  # also by systemctl, or by a user whose records do not count
        elif kind == UNIT_STARTING:
            self._running.pop(life, None)


def life_of(record: Mapping[str, Any]) -> str:
    """The INVOCATION_ID in a record of systemd."""
    return str(record.get("INVOCATION_ID") or record.get("USER_INVOCATION_ID") or "")
