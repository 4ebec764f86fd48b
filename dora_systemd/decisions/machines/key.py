"""The key of a machine, which only allows a link to log in and to run its part. Pure.

See AUTHORIZED_KEYS FILE FORMAT in sshd(8). sshd runs the forced command, and puts the command that
the link requested into a variable.
"""

import re
import shlex

from dora_systemd.decisions.machines.wire import PORT_RANGE
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted

ORIGINAL = "SSH_ORIGINAL_COMMAND"
_SHELL = 5
"""The words before the mark, see remote_command(): exec sh -c SCRIPT doractl."""
_PUBLIC = re.compile(r"ssh-[a-z0-9-]+ [A-Za-z0-9+/=]+")
_MARK = re.compile(r"[a-z]+-[0-9a-f]{32}")


def authorized_line(program: str, public: str, comment: str) -> str:
    """The line for authorized_keys. program: absolute path of doractl on that machine.

    Forwards are for the ports of links on 127.0.0.1 only. Raises DoraSystemdError (BAD_INPUT) for
    what is no public key, and for a path that cannot stand there.
    """
    if not re.fullmatch(r"/[A-Za-z0-9_./+-]+", program):
        raise _refusal(f"cannot use {quoted(program)} there as doractl", "link it into /usr/bin")
    key = _public(public)
    # sshd(8) has no ranges there, and * would be each service that listens on that machine.
    only = ",".join(
        f'{option}="127.0.0.1:{port}"'
        for option in ("permitlisten", "permitopen")
        for port in PORT_RANGE
    )
    forced = f'command="{program} member"'
    return f"restrict,port-forwarding,{only},{forced} {key} {comment}"


def key_text(public: str) -> str:
    """Return the unique part of a public key, or raise DoraSystemdError (BAD_INPUT)."""
    return _public(public).split()[1]


def _public(text: str) -> str:
    """The key without its comment."""
    found = _PUBLIC.match(text)
    if not found:
        raise _refusal("cannot read the public key", "see ssh-keygen(1)")
    return found[0]


def forced_words(original: str) -> tuple[str, list[str]]:
    """Parse the command that the link requested: the mark to print, the arguments of doractl.

    Raises DoraSystemdError (USAGE) for everything that is no part of a dataflow.
    """
    try:
        words = shlex.split(original)
    except ValueError as error:
        raise _not_allowed() from error
    mark, *arguments = words[_SHELL:] or [""]
    if not _MARK.fullmatch(mark) or arguments[:1] != ["member"]:
        raise _not_allowed()
    return mark, arguments[1:]


def _not_allowed() -> DoraSystemdError:
    hint = "log in with another key"
    return DoraSystemdError("this key can only run parts of dataflows", hint, ExitCode.USAGE)


def _refusal(message: str, hint: str) -> DoraSystemdError:
    return DoraSystemdError(message, hint, ExitCode.BAD_INPUT)
