"""`doractl logs` of several hosts: one stream, in the order of time, with the host in front."""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

from dora_systemd.cli.colors import wants_colors
from dora_systemd.cli.edge import write_own
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.decisions.logs.query import journal_timestamp
from dora_systemd.decisions.logs.terminal import TerminalLines
from dora_systemd.decisions.remote.failures import too_much
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.remote.merge import Merge
from dora_systemd.decisions.remote.records import TIME, Records, time_of
from dora_systemd.decisions.remote.stream import with_host
from dora_systemd.decisions.remote.words import with_output
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import shown_log

FORMS = {"short": "export", "cat": "export", "json": "json"}
"""By the output that was asked for, the output that the hosts are asked for."""


def words_of_logs(plan: Plan) -> list[str]:
    """What each host is asked for. Raises DoraSystemdError (USAGE)."""
    form = str(plan.options["output"])
    if form not in FORMS:
        hint = f"-o {' or -o '.join(FORMS)}"
        raise DoraSystemdError(f"cannot merge -o {form} of several hosts", hint, ExitCode.USAGE)
    return with_output([*plan.words], FORMS[form])


class LogPrinter:
    """Merges the records. is_complete of Talks decides when the first ones may be printed.

    key: what JSON objects call the host.
    """

    def __init__(
        self, hosts: Sequence[Host], options: Mapping[str, Any], key: str = "host"
    ) -> None:
        self._key = key
        self._form = str(options["output"])
        is_follow = bool(options["is_follow"] or options["until_end"])
        names = [one.text for one in hosts]
        self.merge = Merge(names, is_follow, bool(options["is_reverse"]))
        self._records = {one: Records() for one in hosts}
        self._width = max(map(len, names))
        is_one = len(options["selectors"]) == 1
        has_colors = wants_colors(sys.stdout)
        self._terminal = TerminalLines(want_dataflow=not is_one, want_colors=has_colors)
        self._is_complete = False
        self._last = dict.fromkeys(hosts, 0)

    def said(self, host: Host, data: bytes) -> DoraSystemdError | None:
        """Take records."""
        records, now = self._records[host], time.monotonic()
        if self._form == "json":
            for value in records.objects(data):
                line = json.dumps(with_host(value, host.text, self._key)).encode() + b"\n"
                self._add(host, time_of(value.get(TIME)), line, now)
            return None
        for record in records.exported(data):
            self._add(host, int(record[TIME]), self._line(host, record), now)
        return too_much(host) if records.is_too_much else None

    def _add(self, host: Host, at_us: int, line: bytes, now: float) -> None:
        self._last[host] = max(self._last[host], at_us)
        self.merge.add(host.text, at_us, line, now)

    def again(self, host: Host, words: Sequence[str]) -> list[str]:
        """What a host is asked for when it is back: the lines after the last one."""
        self._records[host] = Records()
        self.merge.begin(host.text)
        since = self._last[host] + 1
        # Not only the last ones; without a line yet, as at first.
        return (
            [*words, f"--since={journal_timestamp(since)}", "-n", "all"] if since > 1 else [*words]
        )

    def ended(self, host: Host, error: DoraSystemdError | None) -> DoraSystemdError | None:
        """No more of this host."""
        del error
        self.merge.end(host.text)
        return None

    def look(self, is_complete: bool) -> None:
        """Print what is due. is_complete: every host was reached or given up."""
        self._is_complete |= is_complete
        if self.merge.is_empty:
            return
        held = self.merge.take(time.monotonic(), self._is_complete)
        if text := b"".join(one.data for one in held):
            write_own(sys.stdout, text.decode("utf-8", "backslashreplace"))
            sys.stdout.flush()

    def finish(self) -> None:
        """Print the rest."""
        self.look(is_complete=True)

    def _line(self, host: Host, record: Mapping[str, bytes]) -> bytes:
        cat = shown_log(record.get("MESSAGE", b"")) + b"\n"
        text = cat if self._form == "cat" else self._terminal.record(record)
        start = f"{host.text:<{self._width}} ".encode()
        return b"".join(start + line + b"\n" for line in text[:-1].split(b"\n"))
