"""Errors of requests to hosts by ssh: the reason in ssh's messages, and a hint. Pure."""

import re

from dora_systemd.decisions.remote.hosts import NO_PROGRAM, Host
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.terminal_text import short_line, without_sequences

SSH_FAILED = 255
_OF_SSH = (
    rb"(?:Connection to \S+ closed by remote host\.|Timeout, server \S+ not responding\."
    rb"|client_loop: [^\n]*)"
)
_MOST = 200
_HINT = "hint: "
_CLOSED = "try: ssh {text} true; after failed logins sshd may refuse this machine for a while"
"""PerSourcePenalties of sshd_config(5): ssh itself reports that only with a lower LogLevel."""
_HINTS = (
    ("HAS CHANGED", "if the host was installed again: ssh-keygen -R {name}, then ssh {text}"),
    ("Host key verification failed", "log in once to see and accept its key: ssh {text}"),
    ("Permission denied", "log in with a key that needs no password here: ssh-copy-id {text}"),
    ("Could not resolve", "correct the name, or add it to ~/.ssh/config"),
    ("Connection refused", "start sshd there, or give its port: {name}:PORT"),
    ("timed out", "check that the host is on, and that the network leads to it"),
    ("No route to host", "check that the host is on, and that the network leads to it"),
    ("Connection reset", _CLOSED),
)
_INSTALL = "install dora-systemd there, or link it into /usr/local/bin: ssh has a PATH of its own"


def unreached(host: Host, words: str) -> DoraSystemdError:
    """Return the error of a host that ssh cannot reach. words: messages of ssh and the host."""
    other = "try: ssh {text} true" if words else _CLOSED
    hint = next((hint for part, hint in _HINTS if part in words), other)
    name = host.destination.rpartition("@")[2]
    hint = hint.format(text=_by_ssh(host), name=name)
    reason = "the host key has changed" if "HAS CHANGED" in words else last_line(words)
    return _error(f"cannot reach {host.text}: {reason or 'ssh failed'}", hint)


def _by_ssh(host: Host) -> str:
    return f"-p {host.port} {host.destination}" if host.port else host.destination


def lost(host: Host, words: str = "") -> DoraSystemdError:
    """Return the error of a host that was reached, and then lost.

    words: what ssh and doractl on the host have written; only ssh knows why it is lost.
    """
    said = re.findall(_OF_SSH, words.encode())
    reason = f": {last_line(said[-1].decode())}" if said else ""
    hint = f"what was asked may be done or not: doractl -H {host.text} list"
    return _error(f"the connection to {host.text} is lost{reason}", hint)


def silent(host: Host, seconds: float, what: str) -> DoraSystemdError:
    """The error of a host that did not answer in time. what: what it did not do."""
    message = f"cannot reach {host.text}: {what} within {seconds:g}s"
    return _error(message, f"try: ssh {_by_ssh(host)} true")


def mute(host: Host, seconds: float) -> DoraSystemdError:
    """The error of a host that has begun, and then gave no sign of life for so long."""
    hint = f"what was asked may be done or not: doractl -H {host.text} releases"
    return _error(f"the connection to {host.text} is lost: no word for {seconds:g}s", hint)


def without_doractl(host: Host) -> DoraSystemdError:
    """The error of a host where no doractl was found."""
    return _error(f"cannot find doractl on {host.text}", _INSTALL)


def not_run(host: Host, words: str) -> DoraSystemdError:
    """Return the error of a host whose login shell did not run the command."""
    reason = last_line(words) or "its login shell ends at once"
    hint = "the account needs a shell that runs commands, see chsh(1) and sshd_config(5)"
    return _error(f"cannot run doractl on {host.text}: {reason}", hint)


def invalid(host: Host) -> DoraSystemdError:
    """The error of a host whose answer cannot be read."""
    hint = f"compare the versions: doractl version, and doractl -H {host.text} version"
    return _error(f"cannot read the answer of {host.text}", hint)


def too_much(host: Host) -> DoraSystemdError:
    """The error of a host whose answer is larger than any."""
    return _error(f"the answer of {host.text} is too large", "ask for less")


def is_of_ssh(data: bytes) -> bool:
    """Return whether ssh wrote this about a lost connection, which the error repeats."""
    return re.fullmatch(_OF_SSH + rb"\r?\n", data) is not None


def _error(message: str, hint: str) -> DoraSystemdError:
    return DoraSystemdError(message, hint, ExitCode.NO_HOST)


def last_line(words: str) -> str:
    """Return the last line of the messages of ssh or a login shell, without the name of ssh.

    Lines with JSON objects do not count: they are the output that was requested from doractl.
    """
    lines = [line.strip() for line in without_sequences(words).splitlines()]
    lines = [line for line in lines if line and not line.startswith("{")]
    return short_line(lines[-1].removeprefix("ssh: "), _MOST) if lines else ""


def words_of_doractl(complaint: str) -> tuple[str, str]:
    """Parse the last error of doractl on a host, and its hint, from its standard error."""
    said = [one.removeprefix("doractl: ") for one in complaint.splitlines()]
    hints = [one.removeprefix(_HINT) for one in said if one.startswith(_HINT)]
    words = last_line("\n".join(one for one in said if not one.startswith(_HINT)))
    return words, short_line("".join(hints[-1:]), _MOST)


def failed_there(host: Host, complaint: str, status: int) -> DoraSystemdError:
    """The error of a host whose doractl has failed."""
    words, hint = words_of_doractl(complaint)
    return _error(f"doractl on {host.text} has failed: {words or f'exit status {status}'}", hint)


def ending_error(
    host: Host, status: int, is_in: bool, said: str, complaint: str
) -> DoraSystemdError | None:
    """Return why a connection ended; None if doractl itself ended on the host.

    status: exit status of ssh. is_in: whether the mark came. `said`, complaint: the end of standard
    output and error; before the mark, those of ssh and of the login shell.
    """
    if is_in:
        if status == NO_PROGRAM and not complaint:
            return without_doractl(host)
        return lost(host, complaint) if status == SSH_FAILED or status < 0 else None
    return unreached(host, complaint) if status == SSH_FAILED else not_run(host, complaint or said)
