"""journalctl(1) as a child process, and its errors.

Every machine with a journal has journalctl, in the journal's own version. It prints 100,000 records
in the time in which the Python binding reads 5,000.
"""

import os
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.trust.programs import check_program

CHUNK = 1 << 18
"""Bytes of one read from it."""
JOIN = "join the group systemd-journal or adm (usermod -aG) and log in again"
"""The hint to users who can only see their own records."""
_MOST_COMPLAINT = 1 << 20
_NOTICE = "to turn off this notice."
"""The end of journalctl's own hint to them."""


@contextmanager
def open_journalctl(
    arguments: Sequence[str], want_colors: bool = False, outlives_interrupt: bool = False
) -> "Iterator[subprocess.Popen[bytes]]":
    """A running journalctl, which the block ends.

    outlives_interrupt: Ctrl+C on the terminal does not reach it, see setpgid(2).
    Raises DoraSystemdError: NO_SYSTEMD if there is no journalctl, NO_PERMISSION if root would run
    another user's.
    """
    check_program("journalctl")
    environment = {**os.environ, "SYSTEMD_COLORS": "1" if want_colors else "0", "LC_ALL": "C.UTF-8"}
    # Not a pipe, which warnings about damaged files could fill before anything reads it.
    complaints = os.fdopen(os.memfd_create("journalctl"), "rb")
    try:
        child = subprocess.Popen(
            ["journalctl", "--no-pager", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=complaints,
            env=environment,
            process_group=0 if outlives_interrupt else None,
        )
    except OSError as error:
        complaints.close()
        message = f"cannot execute journalctl: {error.strerror}"
        raise DoraSystemdError(message, "it is part of systemd", ExitCode.NO_SYSTEMD) from error
    child.stderr = complaints
    with child:
        try:
            yield child
        finally:
            child.kill()


def end_journalctl(child: "subprocess.Popen[bytes]") -> int:
    """The exit status of a journalctl whose output has been read to its end.

    Raises DoraSystemdError for its error message.
    """
    status = child.wait()
    assert child.stderr
    size = os.fstat(child.stderr.fileno()).st_size
    data = os.pread(child.stderr.fileno(), _MOST_COMPLAINT, max(size - _MOST_COMPLAINT, 0))
    complaint = data.decode("utf-8", "replace").strip()
    if status and complaint and not complaint.endswith(_NOTICE):
        raise _complaint_error(complaint.splitlines()[-1])
    return status


def journal_output(
    arguments: Sequence[str],
    want_colors: bool = False,
    on_end: Callable[[int], object] | None = None,
) -> Iterator[bytes]:
    """Yield the output of journalctl, in chunks. Raises DoraSystemdError for its error message.

    on_end: called with its exit status, unless nobody reads to the end.
    """
    with open_journalctl(arguments, want_colors) as child:
        assert child.stdout
        while data := os.read(child.stdout.fileno(), CHUNK):
            yield data
        status = end_journalctl(child)
        if on_end is not None:
            on_end(status)


def _complaint_error(complaint: str) -> DoraSystemdError:
    if complaint.startswith("Failed to parse timestamp"):
        hint = 'such as "2026-11-20 18:00", "10 min ago", "today" or "5m", see systemd.time(7)'
        return usage_error(f"cannot read the time{complaint[25:]}", hint)
    if complaint.startswith("Bad pattern"):
        return usage_error(f"cannot use the {complaint[4:]}", "see pcre2pattern(3)")
    if complaint.startswith(("Please specify", "--since=", "Failed to parse --lines=")):
        return usage_error(f"cannot read the journal so: {complaint}", "see journalctl(1)")
    if " boot " in complaint:
        hint = "journalctl --list-boots shows them"
        return DoraSystemdError(f"cannot find the boot: {complaint}", hint, ExitCode.NOT_FOUND)
    if "insufficient permissions" in complaint:
        return DoraSystemdError("cannot read the journal", JOIN, ExitCode.NO_PERMISSION)
    return DoraSystemdError(f"cannot read the journal: {complaint}", "see journalctl(1)")
