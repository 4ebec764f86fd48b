"""Warns about other users of the machine: they can reach dora's ports on the host's network.

Nodes and daemon of dora 1.1 use TCP on 127.0.0.1 without authentication. Only firewall rules for
the whole machine could filter by user; those of a unit (IPAddressDeny=, SocketBindDeny=) filter
addresses and ports. So a dataflow needs a private network namespace to be protected.
"""

from collections.abc import Iterator
from pathlib import Path

from dora_systemd.adapters.host.files import read_text
from dora_systemd.decisions.settings.sandbox import NETWORK
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import RUNTIME_NAME, Scope
from dora_systemd.trust.paths import exists
from dora_systemd.verbs.start.linger import linger_note
from dora_systemd.verbs.start.plan import Plan

PASSWD = Path("/etc/passwd")

_LOGINS = range(1000, 65534)
"""The uids of people, see "uids and gids" in Debian's policy, and UIDS-GIDS of systemd."""

_NO_SHELLS = ("nologin", "false", "true", "sync")
_SHOWN = 3


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
