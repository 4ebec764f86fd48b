"""Who else can log in: unless a dataflow has a network of its own, dora's ports are theirs as well.

Nodes and daemon of dora 1.1 speak TCP on 127.0.0.1 and ask nobody who he is. A filter by user
needs rules of a firewall for the whole machine; those of a unit (IPAddressDeny=, SocketBindDeny=)
know addresses and ports, and no users. So a network namespace is what helps.
"""

from collections.abc import Iterator
from pathlib import Path

from dora_systemd.adapters.host.files import read_text
from dora_systemd.decisions.settings.sandbox import NETWORK
from dora_systemd.decisions.views.findings import Finding, State
from dora_systemd.errors import DoraSystemdError
from dora_systemd.scope import Scope
from dora_systemd.verbs.start.plan import Plan

PASSWD = Path("/etc/passwd")

_LOGINS = range(1000, 65534)
"""The uids of people, see "uids and gids" in Debian's policy, and UIDS-GIDS of systemd."""

_NO_SHELLS = ("nologin", "false", "true", "sync")
_SHOWN = 3


def login_users(passwd: str) -> list[str]:
    """The names of those who can log in. passwd: the text of passwd(5); others are not counted."""
    rows = [line.split(":") for line in passwd.splitlines()]
    return [
        row[0]
        for row in rows
        if len(row) == 7
        and row[2].isdecimal()
        and int(row[2]) in _LOGINS
        and row[6].rpartition("/")[2] not in _NO_SHELLS
    ]


def start_notes(plan: Plan, passwd: Path = PASSWD) -> Iterator[str]:
    """What whoever starts a dataflow should know about the others of this machine, if anything.

    Who asks for the host's network by name knows.
    """
    network, is_given = plan.settings[NETWORK], plan.settings.source(NETWORK) != "default"
    if plan.scope.is_user or plan.user is None or network == "private":
        return
    if network == "host" and is_given:
        return
    users = _logins(passwd)
    others = [name for name in users if name != plan.user.pw_name]
    if len(users) > 1 and others:
        yield (
            f"{_names(others)} can log in here and can read, forge and end what the nodes "
            "exchange; --network private prevents it, --network host is for those you trust"
        )


def judge_logins(scope: Scope, passwd: Path = PASSWD) -> Iterator[Finding]:
    """What `doractl doctor` says of them."""
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
