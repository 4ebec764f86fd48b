"""Runs a verb on one host, or on several hosts in parallel.

On one host the verb has this terminal, and its own output and exit status.
"""

import signal
import sys
from codecs import IncrementalDecoder, getincrementaldecoder
from collections.abc import Sequence
from functools import partial
from types import FrameType

from dora_systemd.adapters.ssh import run_on_terminal
from dora_systemd.cli.edge import write_own
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.cli.remote.printers import (
    BlockPrinter,
    Complaints,
    JsonPrinter,
    LinePrinter,
    LogPrinter,
    Printer,
    TablePrinter,
    words_of_logs,
)
from dora_systemd.decisions.remote.command_line import with_output
from dora_systemd.decisions.remote.host_tables import (
    cells_of,
    format_hosts,
    format_releases,
    row_of,
)
from dora_systemd.decisions.remote.hosts import NO_PROGRAM, Host, Way, remote_command, ssh_arguments
from dora_systemd.decisions.remote.ssh_failures import (
    SSH_FAILED,
    is_of_ssh,
    lost,
    unreached,
    without_doractl,
)
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import shown_log
from dora_systemd.verbs.facts.selector import is_pattern
from dora_systemd.verbs.remote.talk import Ended, Said, Talks

_SIGNALS = 128
"""The exit status of a program that a signal has ended is above."""


def is_terminal() -> bool:
    """Whether all three streams are on a terminal, so that the host can have it."""
    return all(stream and stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr))


def run_there(host: Host, plan: Plan) -> int:
    """Run the verb on the terminal there; its exit status. Raises DoraSystemdError (NO_HOST)."""
    command = remote_command(Way.TERMINAL, plan.words, host=host)
    status, said = run_on_terminal(ssh_arguments(host, Way.TERMINAL, command))
    if status == SSH_FAILED and said:
        raise lost(host, said) if is_of_ssh(said.encode()) else unreached(host, said)
    if status == NO_PROGRAM and plan.verb not in ("dora", "inhibit"):
        raise without_doractl(host)
    print(said, end="", file=sys.stderr)
    return status if status >= 0 else 128 - status


def pass_through(host: Host, plan: Plan) -> int:
    """Print what the verb prints there, without a terminal; its exit status.

    Raises DoraSystemdError (NO_HOST).
    """
    talks = Talks([host], plan.way, plan.words, plan.most_seconds, silence=plan.silence)
    status: int = ExitCode.OK
    # A character may be in two pieces.
    decoders = {one: getincrementaldecoder("utf-8")("backslashreplace") for one in (False, True)}
    with Interrupts(talks, plan) as interrupt:
        for event in talks.events():
            if isinstance(event, Said):
                _pass(event, decoders[event.is_error])
            elif isinstance(event, Ended):
                if event.error:
                    raise event.error
                status = event.status
    return ExitCode.INTERRUPTED if interrupt.was_interrupted and status > _SIGNALS else status


def _pass(said: Said, decoder: IncrementalDecoder) -> None:
    if said.is_error:
        print(decoder.decode(said.data), end="", file=sys.stderr)
    elif sys.stdout.isatty():
        write_own(sys.stdout, shown_log(decoder.decode(said.data).encode()).decode())
        sys.stdout.flush()
    else:
        sys.stdout.flush()
        sys.stdout.buffer.write(said.data)
        sys.stdout.buffer.flush()


class Interrupts:
    """In the context, a first Ctrl+C ends following commands on hosts, a second one doractl."""

    def __init__(self, talks: Talks, plan: Plan) -> None:
        self._talks = talks
        self._is_gentle = plan.way is Way.FOLLOWING
        self.was_interrupted = False

    def __enter__(self) -> "Interrupts":
        self._before = signal.signal(signal.SIGINT, self._interrupt)
        return self

    def __exit__(self, *_exception: object) -> None:
        signal.signal(signal.SIGINT, self._before)

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        if self.was_interrupted or not self._is_gentle:
            raise KeyboardInterrupt
        self.was_interrupted = True
        self._talks.hang_up()


def run_on_all(hosts: Sequence[Host], plan: Plan, opening: bytes | None = None) -> int:
    """Run the verb on all hosts; the highest exit status. opening: what each of them reads."""
    words, printer = _printer(hosts, plan)
    logs = printer if isinstance(printer, LogPrinter) else None
    is_full = logs.merge.is_full if logs else lambda _host: False
    way = plan.way if opening is None else Way.FED
    most, silence = plan.most_seconds, plan.silence
    talks = Talks(hosts, way, words, most, is_full, opening=opening, silence=silence)
    complaints = Complaints(plan.wants_json)
    statuses: list[int] = []
    again = _Again(talks, logs, words) if logs and plan.follows_again else None
    with Interrupts(talks, plan) as interrupt:
        for event in talks.events():
            if isinstance(event, Said):
                _take(talks, printer, complaints, event)
            elif isinstance(event, Ended):
                if not (again and again.is_known(event)):
                    statuses.append(_end(printer, complaints, event))
                if again:
                    again.ended(event)
            elif logs:
                logs.look(talks.is_complete)
    printer.finish()
    if interrupt.was_interrupted:
        return ExitCode.INTERRUPTED
    return _worst(statuses, has_grep=bool(logs and plan.options.get("grep")))


class _Again:
    """Follows hosts again that are lost after their login; each loss is reported once."""

    def __init__(self, talks: Talks, logs: LogPrinter, words: Sequence[str]) -> None:
        self._talks, self._logs, self._words = talks, logs, words
        self._lost: set[Host] = set()

    def is_known(self, ended: Ended) -> bool:
        """Whether the host is still unreachable, and its loss was reported before."""
        return ended.error is not None and ended.host in self._lost and not ended.was_in

    def ended(self, ended: Ended) -> None:
        """Connect to the host again, unless its doractl has ended by itself."""
        if ended.error and (ended.was_in or ended.host in self._lost):
            self._lost.add(ended.host)
            self._talks.begin_again(ended.host, self._logs.again(ended.host, self._words))


def _printer(hosts: Sequence[Host], plan: Plan) -> tuple[list[str], Printer]:
    """Return the command for the hosts, and the printer of their answers."""
    if plan.verb == "logs":
        return words_of_logs(plan), LogPrinter(hosts, plan.options, plan.key)
    if plan.verb == "list" and not plan.wants_json:
        if plan.options["is_quiet"]:
            return plan.words, LinePrinter(wants_json=False)
        selector = plan.options["selector"]
        if selector is None or is_pattern(selector):
            nothing = "No dataflow." if _is_wide(plan) else "No dataflow is running."
            shown = partial(format_hosts, sort_by=plan.options["sort_by"])
            table = TablePrinter(hosts, row_of, shown, nothing)
            return with_output(plan.words, "json"), table
    if plan.verb == "releases" and not (plan.wants_json or plan.options["want_history"]):
        releases = TablePrinter(hosts, cells_of, format_releases, "No release.")
        return with_output(plan.words, "json"), releases
    if plan.has_lines and not plan.options.get("dry_run"):
        return plan.words, LinePrinter(plan.wants_json)
    return plan.words, JsonPrinter(hosts) if plan.wants_json else BlockPrinter(hosts)


def _is_wide(plan: Plan) -> bool:
    """Whether `list` shows more than running dataflows."""
    return any(plan.options[name] for name in ("want_all", "last", "status", "pattern", "sort_by"))


def _take(talks: Talks, printer: Printer, complaints: Complaints, said: Said) -> None:
    if said.is_error:
        complaints.said(said.host, said.data)
    elif error := printer.said(said.host, said.data):
        talks.give_up(said.host, error)


def _end(printer: Printer, complaints: Complaints, ended: Ended) -> int:
    error: DoraSystemdError | None = printer.ended(ended.host, ended.error)
    error = ended.error or error
    complaints.ended(ended.host, error)
    return error.code if error else ended.status


def _worst(statuses: Sequence[int], has_grep: bool) -> int:
    """The highest; a pattern need not match on all hosts."""
    worst = max(statuses, default=int(ExitCode.OK))
    return min(statuses) if has_grep and worst == ExitCode.FAILURE else worst
