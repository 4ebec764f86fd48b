"""Records why there is no run of a dataflow, and reads the command line, which can be a reason."""

import asyncio
import contextlib
import os
from collections.abc import Sequence

from dora_systemd.adapters.host import notify
from dora_systemd.adapters.journal.note import JOURNAL_SOCKET
from dora_systemd.adapters.journal.socket import JournalSocket
from dora_systemd.adapters.logs.pipes import LogPipes
from dora_systemd.decisions.cell.environment import with_changes
from dora_systemd.decisions.cell.options import RunnerOptions, known_options, parse_runner_argv
from dora_systemd.decisions.life.causes import Cause
from dora_systemd.decisions.life.refusal import format_refusal
from dora_systemd.decisions.logs.lines import Origin
from dora_systemd.errors import DoraSystemdError

_JOURNAL_SECONDS = 1.0


def tell_failure(pipes: LogPipes, error: DoraSystemdError, cause: Cause) -> None:
    """Record why there is no run of the dataflow, and show it in STATUS=."""
    pipes.write_event("dataflow-failed", reason=error.message, cause=cause)
    notify.send_status(format_refusal(error))


def read_options(argv: Sequence[str], journal_socket: str = JOURNAL_SOCKET) -> RunnerOptions:
    """The options in a command line, with later changes. Raises DoraSystemdError.

    After an upgrade and a crash, systemd starts this version with the command line of another one.
    An error is then recorded under the name that this version can read.
    """
    try:
        return with_changes(parse_runner_argv(argv), os.environ)
    except DoraSystemdError as error:
        with contextlib.suppress(DoraSystemdError):
            known = known_options(argv)
            _record(Origin(known.name, known.uuid), error, journal_socket)
        raise


def _record(origin: Origin, error: DoraSystemdError, journal_socket: str) -> None:
    loop, journal = asyncio.new_event_loop(), JournalSocket(journal_socket)
    pipes = LogPipes(loop, journal, origin)
    tell_failure(pipes, error, Cause.OTHER_VERSION)
    pipes.close(_JOURNAL_SECONDS)
    journal.wait_read(_JOURNAL_SECONDS)
    journal.close()
    loop.close()
