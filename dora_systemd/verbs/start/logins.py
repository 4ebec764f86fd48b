"""Warns about a logout, which ends what a user has started, and about other users who log in.

Other users can reach dora's ports on the host's network.

Nodes and daemon of dora 1.1 use TCP on 127.0.0.1 without authentication. Only firewall rules for
the whole machine could filter by user; those of a unit (IPAddressDeny=, SocketBindDeny=) filter
addresses and ports. So a dataflow needs a private network namespace to be protected.
"""

from collections.abc import Iterator
from pathlib import Path

from dora_systemd.adapters.host.files import read_text
from dora_systemd.adapters.host.process import run_command
from dora_systemd.decisions.settings.sandbox import NETWORK
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import RUNTIME_NAME, Scope
from dora_systemd.trust.paths import exists, user_name
from dora_systemd.verbs.start.plan import Plan

PASSWD = Path("/etc/passwd")

_LOGINS = range(1000, 65534)
"""The uids of people, see "uids and gids" in Debian's policy, and UIDS-GIDS of systemd."""

_NO_SHELLS = ("nologin", "false", "true", "sync")
_SHOWN = 3
_SECONDS = 20.0
_LOGINCTL = ("loginctl", "--no-ask-password")


def login_users(passwd: str) -> list[str]:
    """The names of users who can log in. passwd: text of passwd(5); other sources do not count."""
    rows = [line.split(":") for line in passwd.splitlines()]
    return [
        row[0]
        for row in rows
        if len(row) == 7
        and row[2].isdecimal()
        and int(row[2]) in _LOGINS
        and row[6].rpartition("/")[2] not in _NO_SHELLS
    ]


def has_run_here(scope: Scope) -> bool:
    """Whether a dataflow has been started since the boot; of a user, since the manager began.

    systemd keeps the parent of RuntimeDirectory= of all dataflows after their end.
    """
    return exists(scope.runtime_root / RUNTIME_NAME)


def logout_note(scope: Scope) -> str:
    """A warning, before the first start, that the dataflow ends at logout; or ""."""
    return "" if has_run_here(scope) else linger_note(scope)


def start_notes(plan: Plan, passwd: Path = PASSWD) -> Iterator[str]:
    """Warnings about other users, for someone who starts the first dataflow since the boot.

    There is no warning if the settings name the host's network explicitly.
    """
    network, is_given = plan.settings[NETWORK], plan.settings.source(NETWORK) != "default"
    if plan.scope.is_user or plan.user is None or network == "private":
        return
    if network == "host" and is_given:
        return
    users = _logins(passwd)
    others = [name for name in users if name != plan.user.pw_name]
    if len(users) > 1 and others:
        # Machines only meet in the network of the host.
        way = "" if plan.members else "--network private prevents it, "
        yield (
            f"{_names(others)} can log in and reach what the nodes exchange; "
            f"{way}--network host accepts it"
        )


def judge_logins(scope: Scope, passwd: Path = PASSWD) -> Iterator[Finding]:
    """The findings of `doractl doctor` about other users."""
    users = _logins(passwd)
    if not scope.is_user and len(users) > 1:
        text = f"{_names(users)} can log in, and reach what nodes of any dataflow exchange"
        remedy = "network: private for dataflows whose messages are not for all of them"
        yield Finding("users", State.NOTE, text, remedy)


def _logins(passwd: Path) -> list[str]:
    try:
        return login_users(read_text(passwd))
    except DoraSystemdError:
        return []


def _names(users: list[str]) -> str:
    more = len(users) - _SHOWN
    return ", ".join(users[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


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
