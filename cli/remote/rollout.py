"""`deploy` and `rollback` on other hosts: some at a time, and no more once a trial has failed."""

import shutil
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import click

from dora_systemd.cli.edge import print_warning
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.cli.remote.printers import Complaints
from dora_systemd.cli.remote.run import Interrupts, run_on_all
from dora_systemd.cli.terminal import StageLine
from dora_systemd.decisions.releases.manifest import Stored
from dora_systemd.decisions.releases.parcel import format_parcel, parse_wants, total
from dora_systemd.decisions.remote.command_line import with_options, with_output
from dora_systemd.decisions.remote.hosts import Host, Way
from dora_systemd.decisions.remote.rollout import (
    NOT_TRIED,
    Columns,
    Verdict,
    may_go_on,
    verdict_object,
    verdict_of,
    worst_status,
)
from dora_systemd.decisions.remote.ssh_failures import invalid, too_much
from dora_systemd.decisions.remote.stream import read_json, read_object, with_host
from dora_systemd.decisions.views.objects import error_object, format_json
from dora_systemd.errors import ExitCode
from dora_systemd.values import format_rounded_size
from dora_systemd.verbs.releases.send import Packed, packed
from dora_systemd.verbs.remote.talk import Ended, Said, Talks
from dora_systemd.verbs.start.request import StartRequest

SILENCE_SECONDS = 600.0
"""Time after which a host is given up that sends and receives nothing, because its doractl or its
disk hangs. ssh notices by itself when the network or sshd hangs. doractl reports its step every
30 s, but not while it checks files, syncs 4 GiB to an SD card, or removes an old release."""
_RECEIVE = "--from-stdin"
_MOST = 1 << 20
"""Maximum bytes of a host's answers, and of its errors before the first answer."""


def roll_out(hosts: Sequence[Host], plan: Plan) -> int:
    """Run the verb on the hosts; the exit status. Raises DoraSystemdError."""
    with StageLine(sys.stderr) as stage:
        if plan.verb == "deploy":
            return _deploy(hosts, plan, stage)
        return Rollout(_talks(hosts, plan, plan.way, plan.loud), plan, stage).run(hosts)


def _talks(
    hosts: Sequence[Host], plan: Plan, way: Way, words: list[str], opening: bytes | None = None
) -> Talks:
    """Return Talks in which each host reports its steps, also with -q, as signs of life."""
    return Talks(
        hosts,
        way,
        with_output(words, "json"),
        at_once=plan.options["serial"],
        opening=opening,
        silence=SILENCE_SECONDS,
    )


def _deploy(hosts: Sequence[Host], plan: Plan, stage: StageLine) -> int:
    options, words = plan.options, with_options(plan.words, _RECEIVE)
    request = StartRequest(options["dataflow"], options["name"], options)

    def warn(text: str) -> None:
        stage.wipe()
        print_warning(text, plan.wants_json)

    with packed(request, stage, warn) as package:
        stage.wipe()
        opening = format_parcel(package.parcel)
        if options["dry_run"]:
            return run_on_all(hosts, plan._replace(words=words), opening)
        talks = _talks(hosts, plan, Way.FED, with_options(plan.loud, _RECEIVE), opening)
        return Rollout(talks, plan, stage, package).run(hosts)


class _Answer:
    """The answer of a host. is_taking: whether the host needs no more files."""

    def __init__(self, is_taking: bool) -> None:
        self.is_taking = is_taking
        self.text = b""
        self.complaint = b""

    @property
    def outcome(self) -> dict[str, Any]:
        """The object of its outcome, {} without one."""
        return read_object(self.text.decode("utf-8", "replace")) or {}

    @property
    def problem(self) -> dict[str, Any] | None:
        """The last error that it has complained of."""
        values = map(read_object, self.complaint.decode(errors="replace").splitlines())
        found = [one["error"] for one in values if one and one.get("error")]
        return found[-1] if found and isinstance(found[-1], dict) else None

    @property
    def errors(self) -> bytes:
        """The errors of the host, without what -q leaves out."""
        lines = self.complaint.splitlines(keepends=True)
        values = ((line, read_object(line.decode(errors="replace"))) for line in lines)
        return b"".join(line for line, value in values if value is None or "error" in value)

    def take_line(self) -> str | None:
        """The first line, None if it is not complete."""
        line, end, rest = self.text.partition(b"\n")
        if not end:
            return None
        self.text = rest
        return line.decode("utf-8", "replace")


class Rollout:
    """Hosts that get a release. package: what is sent to them."""

    def __init__(
        self, talks: Talks, plan: Plan, stage: StageLine, package: Packed | None = None
    ) -> None:
        self._talks, self._plan, self._stage, self._package = talks, plan, stage, package
        self._is_quiet = plan.options["is_quiet"]
        self._complaints = Complaints(plan.wants_json)
        self._answers: dict[Host, _Answer] = {}
        self._sending: dict[Host, str] = {}
        self._statuses: dict[Host, int] = {}

    def run(self, hosts: Sequence[Host]) -> int:
        """Run the rollout on all hosts; return the exit status."""
        width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
        self._columns = Columns(self._plan.verb, [one.text for one in hosts], width)
        if not (self._plan.wants_json or self._is_quiet):
            click.echo(self._columns.header)
        with Interrupts(self._talks, self._plan) as interrupt:
            for event in self._talks.events():
                if isinstance(event, Said):
                    self._take(event)
                elif isinstance(event, Ended):
                    self._end(event)
                else:
                    self._show_stage()
        for host in hosts:
            if host not in self._statuses:
                self._print(host, Verdict(host.text, NOT_TRIED), {}, None)
        statuses = [*self._statuses.values()]
        return ExitCode.INTERRUPTED if interrupt.was_interrupted else worst_status(statuses)

    def _answer(self, host: Host) -> _Answer:
        return self._answers.setdefault(host, _Answer(is_taking=self._package is None))

    def _take(self, said: Said) -> None:
        answer = self._answer(said.host)
        if said.is_error:
            answer.complaint = (answer.complaint + said.data)[-_MOST:]
            return
        answer.text += said.data
        if len(answer.text) > _MOST:
            self._talks.give_up(said.host, too_much(said.host))
        elif not answer.is_taking and (line := answer.take_line()) is not None:
            self._send(said.host, answer, line)

    def _send(self, host: Host, answer: _Answer, line: str) -> None:
        assert self._package is not None
        answer.is_taking = True
        contents = parse_wants(read_json(line), self._package.parcel)
        if contents is None:
            self._talks.give_up(host, invalid(host))
        else:
            self._talks.say(host, self._chunks(self._package, host, contents))

    def _chunks(self, package: Packed, host: Host, contents: Sequence[Stored]) -> Iterator[bytes]:
        whole, done = format_rounded_size(total(contents)), 0
        for one in contents:
            for chunk in package.spool.read(one):
                self._sending[host] = f", sending {format_rounded_size(done)} of {whole}"
                done += len(chunk)
                yield chunk
        self._sending[host] = ""

    def _show_stage(self) -> None:
        if now := [f"{one.text}{self._sending.get(one, '')}" for one in self._talks.present]:
            self._stage(f"{self._plan.verb}: {'; '.join(now)}")

    def _end(self, ended: Ended) -> None:
        host, answer = ended.host, self._answer(ended.host)
        self._stage.wipe()
        error, outcome = ended.error, answer.outcome
        if not (error or ended.status or outcome):
            error = invalid(host)
        self._complaints.said(host, answer.errors if self._is_quiet else answer.complaint)
        self._complaints.ended(host, error)
        self._statuses[host] = error.code if error else ended.status
        verdict = verdict_of(host, self._plan.verb, ended, error, outcome)
        if not may_go_on(self._plan.verb, verdict.word):
            self._talks.begin_no_more()
        problem = error_object(error) if error else answer.problem
        self._print(host, verdict, outcome, problem)

    def _print(
        self, host: Host, verdict: Verdict, outcome: dict[str, Any], problem: dict[str, Any] | None
    ) -> None:
        if self._is_quiet:
            return
        if self._plan.wants_json:
            name = self._package.parcel.name if self._package else self._plan.options["selector"]
            found = outcome or verdict_object(verdict, self._plan.verb, name, problem)
            click.echo(format_json(with_host(found, host.text)))
        else:
            click.echo(self._columns.row(verdict))
