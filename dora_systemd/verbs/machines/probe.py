"""Checks by ssh whether a machine can be a member, with the login of its link."""

import itertools
import os
import random
import subprocess
import time
from collections.abc import Sequence
from typing import NamedTuple

from dora_systemd.adapters.host.addresses import port_error
from dora_systemd.adapters.host.process import read_child
from dora_systemd.adapters.ssh import start_ssh
from dora_systemd.decisions.cell.machines import HEAD
from dora_systemd.decisions.machines.description import Facts, parse_facts
from dora_systemd.decisions.machines.link_command import LinkOptions, ssh_link_arguments
from dora_systemd.decisions.machines.wire import PORT_RANGE, Forwards
from dora_systemd.decisions.remote.hosts import Host, Way, quote, remote_command, ssh_arguments
from dora_systemd.decisions.remote.ssh_failures import ending_error, failed_there, lost, silent
from dora_systemd.decisions.remote.stream import AfterMark
from dora_systemd.errors import TimedOut

SECONDS = 60.0
_FACTS = ("member", "--facts")
_TRIES = 100
_MICROSECOND_NS = 1000


class Probe(NamedTuple):
    """The description of a machine."""

    facts: Facts
    skew: int  # µs that its clock is ahead of ours


def probe_as_caller(host: Host) -> Probe:
    """Probe a machine with the caller's keys; ssh may prompt. Raises DoraSystemdError (NO_HOST)."""
    mark = _mark()
    arguments = ssh_arguments(host, Way.ONCE, remote_command(Way.ONCE, _FACTS, mark))
    return _probe(host, _asking(arguments), mark)


def ask_as_caller(host: Host, words: Sequence[str]) -> str:
    """Return the output of doractl on a host, with the caller's keys.

    Raises DoraSystemdError (NO_HOST).
    """
    mark = _mark()
    arguments = ssh_arguments(host, Way.ONCE, remote_command(Way.ONCE, words, mark))
    status, output, errors = _run(host, arguments)
    answer = _require(host, mark, output, errors, status)
    if status:
        raise lost(host, errors.decode("utf-8", "replace"))
    return answer


def probe_as_link(host: Host, machine: str, identity: str) -> Probe:
    """Probe a machine with the login and the forwards of its link. identity: its key, or "".

    Raises DoraSystemdError (NO_HOST).
    """
    mark = _mark()
    free = (port for port in random.sample(PORT_RANGE, _TRIES) if not port_error(port))
    coordinator, own, other = itertools.islice(free, 3)
    forwards = Forwards(coordinator, {HEAD: own, machine: other})
    link = LinkOptions("/", machine, host.text, _FACTS, identity)
    return _probe(host, ssh_link_arguments(link, forwards, mark), mark)


def run_there(host: Host, script: str, *words: str) -> None:
    """Run a script of sh(1), on one line, as the caller. Raises DoraSystemdError (NO_HOST)."""
    mark = _mark()
    whole = f'echo "$1"; echo "$1" >&2; shift; {script}'
    command = " ".join(["exec", "sh", "-c", *map(quote, (whole, "sh", mark, *words))])
    status, output, errors = _run(host, _asking(ssh_arguments(host, Way.ONCE, command)))
    _require(host, mark, output, errors, status)
    if status:
        raise lost(host, errors.decode("utf-8", "replace"))


def _asking(arguments: Sequence[str]) -> list[str]:
    """Remove BatchMode, so that ssh may prompt for a password, or about a host key."""
    at = list(arguments).index("BatchMode=yes")
    return [*arguments[: at - 1], *arguments[at + 1 :]]


def _probe(host: Host, arguments: Sequence[str], mark: str) -> Probe:
    begun = time.time_ns()
    status, output, errors = _run(host, arguments)
    ended = time.time_ns()
    answer = _require(host, mark, output, errors, status)
    if status:
        complained = AfterMark(mark).feed(errors).decode("utf-8", "replace")
        raise failed_there(host, complained, status)
    facts = parse_facts(answer)
    return Probe(facts, _skew(facts.now, begun // _MICROSECOND_NS, ended // _MICROSECOND_NS))


def _skew(now: int, begun: int, ended: int) -> int:
    """Return how far the other clock is ahead, at least: it was read between these two of ours."""
    return min(now - begun, 0) + max(now - ended, 0)


def _require(host: Host, mark: str, output: bytes, errors: bytes, status: int) -> str:
    """Return the output after the mark. Raises DoraSystemdError (NO_HOST) without the mark."""
    said, complained = AfterMark(mark), AfterMark(mark)
    answer, complaint = said.feed(output), complained.feed(errors)
    words = (said.noise, complaint if said.is_open else complained.noise)
    texts = [one.decode("utf-8", "replace") for one in words]
    if error := ending_error(host, status, said.is_open, *texts):
        raise error
    return answer.decode("utf-8", "replace")


def _run(
    host: Host, arguments: Sequence[str], seconds: float = SECONDS
) -> tuple[int, bytes, bytes]:
    """Run ssh; return its exit status and bounded output, as the machine may send without limit."""
    pipe = subprocess.PIPE
    deadline = time.monotonic() + seconds
    with start_ssh(arguments, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe) as child:
        try:
            status, (output, errors) = read_child(child, deadline, "ssh")
        except TimedOut as error:
            raise silent(host, seconds, "no answer") from error
        finally:
            child.kill()  # nothing, if it has ended
        return status, output, errors


def _mark() -> str:
    return f"doractl-{os.urandom(16).hex()}"
