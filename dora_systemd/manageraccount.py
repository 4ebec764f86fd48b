"""Whom the nodes of a dataflow run as, and what that user can reach."""

import os
import pwd
from collections.abc import Sequence
from pathlib import Path

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.process import Account, run_command
from dora_systemd.scope import Scope
from dora_systemd.values import quoted

DEFAULT_USER = "dora"
"""Runs the dataflows whose files are root's; the package makes that user."""

_TEST_SECONDS = 10.0
# Asked as that user: access control lists, groups and mounts are the kernel's business.
_TEST_SCRIPT = 'for one; do test "-${one%%:*}" "${one#*:}" || { echo "${one#*:}"; exit 1; }; done'


def choose_user(scope: Scope, wanted: str | None, dataflow: Path) -> pwd.struct_passwd | None:
    """The user for User=, or None where the manager's own user runs everything.

    Default: the owner of the dataflow file, DEFAULT_USER if that is root. Raises DoraSystemdError.
    """
    if scope.is_user:
        if wanted is not None:
            raise DoraSystemdError(
                "cannot choose the user of a dataflow with --user",
                "leave --uid out, or use --system as root",
                ExitCode.USAGE,
            )
        return None
    if wanted is not None:
        return _entry(wanted)
    owner = dataflow.stat().st_uid
    return _default_entry() if owner == 0 else _owner_entry(owner, dataflow)


def account_of(user: pwd.struct_passwd | None) -> Account | None:
    """What a child needs to become `user`; None for no change, which is all that others can do."""
    if user is None or os.geteuid() != 0:
        return None
    groups = os.getgrouplist(user.pw_name, user.pw_gid)
    return Account(user.pw_uid, user.pw_gid, tuple(groups))


def check_access(
    user: pwd.struct_passwd | None, readable: Sequence[str], executable: Sequence[str]
) -> None:
    """Raise DoraSystemdError (NO_PERMISSION) for the first path that the user cannot reach.

    executable: programs, and directories to enter.
    """
    tests = [f"r:{path}" for path in readable] + [f"x:{path}" for path in executable]
    command = ("/bin/sh", "-c", _TEST_SCRIPT, "sh", *tests)
    done = run_command(command, _TEST_SECONDS, directory="/", account=account_of(user))
    if done.status:
        name = user.pw_name if user else pwd.getpwuid(os.getuid()).pw_name
        where = "put it where that user can read it, or choose another user with --uid"
        raise DoraSystemdError(
            f"cannot start the dataflow as user {name}, who cannot reach {done.stdout.strip()}",
            where if user else "correct its permissions",
            ExitCode.NO_PERMISSION,
        )


def _entry(wanted: str) -> pwd.struct_passwd:
    try:
        return pwd.getpwuid(int(wanted)) if wanted.isdecimal() else pwd.getpwnam(wanted)
    except (KeyError, OverflowError) as error:
        raise DoraSystemdError(
            f"cannot find a user {quoted(wanted)}", "see getent passwd", ExitCode.USAGE
        ) from error


def _owner_entry(owner: int, dataflow: Path) -> pwd.struct_passwd:
    try:
        return pwd.getpwuid(owner)
    except KeyError as error:
        raise DoraSystemdError(
            f"cannot choose a user: the owner of {dataflow} is {owner}, which has no name",
            "choose one with --uid USER",
            ExitCode.BAD_INPUT,
        ) from error


def _default_entry() -> pwd.struct_passwd:
    try:
        return pwd.getpwnam(DEFAULT_USER)
    except KeyError as error:
        raise DoraSystemdError(
            f"cannot choose a user: the dataflow is root's and there is no user {DEFAULT_USER}",
            f"choose one with --uid USER, or make it: useradd --system {DEFAULT_USER}",
            ExitCode.BAD_INPUT,
        ) from error
