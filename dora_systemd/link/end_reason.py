"""Finds the reason of an ended connection, for the head, in what ssh wrote."""

from dora_systemd.decisions.machines.wire import FromLink, Lost, Taken, Unreached
from dora_systemd.decisions.remote.hosts import Host, parse_host
from dora_systemd.decisions.remote.ssh_failures import (
    SSH_FAILED,
    ending_error,
    failed_there,
    last_line,
)
from dora_systemd.errors import DoraSystemdError, ExitCode

_FINAL = ("HAS CHANGED", "Host key verification failed", "Permission denied")
"""Errors of ssh that no new attempt clears, only a person."""
_FORWARDING = ("forwarding failed for listen port", "Could not request local forwarding")
_ONCE, _TWICE = 1, 2
"""A machine that boots may answer the next attempt. If a person waits, the name may be mistyped."""
_VERSIONS = "install the same version of dora-systemd on both machines"


def last_word(host: str, status: int, is_in: bool, said: str, complaint: str) -> FromLink:
    """Return why the connection has ended, and whether to try again.

    Parameters as for ending_error().
    """
    if any(one in complaint for one in _FORWARDING):
        hint = "in sshd_config there: AllowTcpForwarding yes; each start takes other ports"
        return Taken(f"cannot forward a port to {host}: {last_line(complaint)}", hint)
    error = ending_error(parse_host(host), status, is_in, said, complaint)
    if not is_in and error:
        return _not_in(error, status, complaint)
    if is_in and status not in (0, SSH_FAILED) and status > 0:
        return _without_member(parse_host(host), error, status, complaint)
    words = last_line(complaint) or ("" if is_in else last_line(said))
    return Lost(words or (f"exit status {status}" if status else "it has ended"))


def _not_in(error: DoraSystemdError, status: int, complaint: str) -> Lost | Unreached:
    """Return the reason, if ssh or the login shell on the host has not run doractl."""
    if any(one in complaint for one in _FINAL):
        return Unreached(error.message, error.hint, 0)
    if status != SSH_FAILED and status > 0:  # the login shell
        return Unreached(error.message, error.hint, _TWICE)
    if "Could not resolve" in complaint:
        return Unreached(error.message, error.hint, _ONCE)
    return Lost(last_line(complaint) or f"exit status {status}")


def _without_member(
    host: Host, error: DoraSystemdError | None, status: int, complaint: str
) -> Unreached:
    """Return the reason, if doractl ran on the host and has not become a member."""
    if error:
        return Unreached(error.message, error.hint, 0)
    failed, tries = failed_there(host, complaint, status), _TWICE
    reason, hint = failed.message, failed.hint
    if status == ExitCode.USAGE:
        tries, hint = 0, _VERSIONS
    if status == ExitCode.NO_PERMISSION:  # another key has logged in, see RESTRICTED
        tries = 0
    return Unreached(reason, hint, tries)
