"""Lingering: whether a user's manager runs without a session, from boot on, see loginctl(1)."""

from dora_systemd.adapters.host.process import run_command
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import user_name

_SECONDS = 20.0
_LOGINCTL = ("loginctl", "--no-ask-password")


def is_lingering(scope: Scope) -> bool | None:
    """Whether the manager of the scope's user starts at boot; None if logind does not answer."""
    command = (*_LOGINCTL, "show-user", "--property=Linger", "--value", str(scope.uid))
    try:
        answer = run_command(command, _SECONDS).stdout.strip()
    except DoraSystemdError:
        return None
    return {"yes": True, "no": False}.get(answer)


def linger_command(scope: Scope) -> str:
    """The command by which root enables lingering."""
    return f"loginctl enable-linger {_user_name(scope)}"


def ensure_linger(scope: Scope) -> str:
    """Enable lingering for the user; a message about that, or "".

    On most machines polkit lets users do that for themselves.
    """
    if not scope.is_user or is_lingering(scope):
        return ""
    try:
        done = run_command((*_LOGINCTL, "enable-linger", str(scope.uid)), _SECONDS)
    except DoraSystemdError:
        done = None
    if done is not None and done.status == 0:
        return f"lingering is now on for {_user_name(scope)}: dataflows start at boot, not at login"
    return (
        f"it will start when {_user_name(scope)} logs in, not at boot; "
        f"for that, as root: {linger_command(scope)}"
    )


def linger_note(scope: Scope) -> str:
    """A warning that the dataflow ends at logout, or ""."""
    if not scope.is_user or is_lingering(scope) is not False:
        return ""
    return (
        f"it ends when {_user_name(scope)} logs out; "
        f"to keep it running, as root: {linger_command(scope)}"
    )


def _user_name(scope: Scope) -> str:
    return user_name(scope.uid, nameless="")
