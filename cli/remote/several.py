"""A verb on several hosts at the same time."""

from collections.abc import Sequence
from functools import partial

from dora_systemd.cli.remote.logs import LogPrinter, words_of_logs
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.cli.remote.printers import (
    BlockPrinter,
    Complaints,
    JsonPrinter,
    LinePrinter,
    Printer,
)
from dora_systemd.cli.remote.single import Interrupts
from dora_systemd.cli.remote.tables import TablePrinter
from dora_systemd.decisions.remote.command import Way
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.remote.table import cells_of, format_hosts, format_releases, row_of
from dora_systemd.decisions.remote.words import with_output
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.verbs.facts.selector import is_pattern
from dora_systemd.verbs.remote.talk import Ended, Said, Talks


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
    """Follows hosts again that are lost after their login: that is said once."""

    def __init__(self, talks: Talks, logs: LogPrinter, words: Sequence[str]) -> None:
        self._talks, self._logs, self._words = talks, logs, words
        self._lost: set[Host] = set()

    def is_known(self, ended: Ended) -> bool:
        """Whether the host is away for longer: then its end is no news."""
        return ended.error is not None and ended.host in self._lost and not ended.was_in

    def ended(self, ended: Ended) -> None:
        """Talk with the host again, unless its doractl has ended by itself."""
        if ended.error and (ended.was_in or ended.host in self._lost):
            self._lost.add(ended.host)
            self._talks.begin_again(ended.host, self._logs.again(ended.host, self._words))


def _printer(hosts: Sequence[Host], plan: Plan) -> tuple[list[str], Printer]:
    """What the hosts are asked for, and what prints their answers."""
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
    """Whether `list` looks for more than what runs."""
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
