"""A verb on one host: as there, with its terminal, its output and its exit status."""

import signal
import sys
from codecs import IncrementalDecoder, getincrementaldecoder
from types import FrameType

from dora_systemd.adapters.ssh import run_on_terminal
from dora_systemd.cli.edge import write_own
from dora_systemd.cli.remote.plan import Plan
from dora_systemd.decisions.remote.command import (
    NO_PROGRAM,
    Way,
    remote_command,
    ssh_arguments,
)
from dora_systemd.decisions.remote.failures import (
    SSH_FAILED,
    is_of_ssh,
    lost,
    unreached,
    without_doractl,
)
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.errors import ExitCode
from dora_systemd.terminal_text import shown_log
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
    """During the block, a first Ctrl+C ends what follows over there, and a second one this."""

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
