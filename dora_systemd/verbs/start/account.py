"""Chooses the user that the nodes of a dataflow run as."""

import os
import pwd

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.scope import Scope
from dora_systemd.trust.paths import Place, reached, user_name
from dora_systemd.trust.programs import Account, account_from
from dora_systemd.values import quoted, shown

DEFAULT_USER = "dora"
_MOST_DIGITS = 10  # of a uid
"""Runs the dataflows whose files belong to root; the package creates this user."""


def choose_user(
    scope: Scope, wanted: str | None, dataflow: Place, directory: str
) -> pwd.struct_passwd | None:
    """The user for User=, or None if everything runs as the manager's own user.

    Default: the owner of the dataflow file that was read, or DEFAULT_USER if that is root.
    directory: that of the programs. Raises DoraSystemdError.
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
    try:
        with reached(directory) as (_, place):
            check_identity(dataflow, place)
    except OSError as error:
        # Its owner could put it back after this, so what cannot be checked is refused. The words
        # are those of Look.check_reach(): they do not tell what root can see.
        raise no_directory(directory) from error
    return _default_entry() if dataflow.uid == 0 else _owner_entry(dataflow.uid, dataflow.path)


def no_directory(directory: str) -> DoraSystemdError:
    """The error for a working directory that is none."""
    message = f"cannot use {shown(directory)} as working directory: it is not a directory"
    return DoraSystemdError(message, "correct --working-directory", ExitCode.BAD_INPUT)


def account_of(user: pwd.struct_passwd | None) -> Account | None:
    """The account to run children as; None: no change, as for all callers other than root."""
    if user is None or os.geteuid() != 0:
        return None
    return account_from(user)


def check_identity(dataflow: Place, directory: Place) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if the owner of `dataflow` may not want this.

    The programs come from `directory`. Nobody must get own programs run as another user by placing
    that user's dataflow file beside them.
    """
    reason = dataflow.borrowed or directory.borrowed
    if directory.uid not in (0, dataflow.uid):
        reason = reason or f"{user_name(directory.uid)} owns {shown(directory.path)}"
    if directory.is_open:
        reason = reason or f"everybody can write in {shown(directory.path)}"
    if reason:
        raise DoraSystemdError(
            f"cannot choose a user by the owner of {shown(dataflow.path)}: {reason}",
            "choose one with --uid USER",
            ExitCode.BAD_INPUT,
        )


def _entry(wanted: str) -> pwd.struct_passwd:
    refusal = DoraSystemdError(
        f"cannot find a user {quoted(wanted)}", "see getent passwd", ExitCode.USAGE
    )
    is_number = wanted.isascii() and wanted.isdigit() and len(wanted) <= _MOST_DIGITS
    return _known(int(wanted) if is_number else wanted, refusal)


def _owner_entry(owner: int, dataflow: str) -> pwd.struct_passwd:
    message = f"cannot choose a user: the owner of {dataflow} is {owner}, which has no name"
    hint = "choose one with --uid USER"
    return _known(owner, DoraSystemdError(message, hint, ExitCode.BAD_INPUT))


def _default_entry() -> pwd.struct_passwd:
    message = f"cannot choose a user: the dataflow is root's and there is no user {DEFAULT_USER}"
    hint = f"choose one with --uid USER, or make it: useradd --system {DEFAULT_USER}"
    return _known(DEFAULT_USER, DoraSystemdError(message, hint, ExitCode.BAD_INPUT))


def _known(user: int | str, refusal: DoraSystemdError) -> pwd.struct_passwd:
    """The entry of a uid or a name. Raises `refusal` if there is none."""
    try:
        return pwd.getpwuid(user) if isinstance(user, int) else pwd.getpwnam(user)
    except (KeyError, OverflowError) as error:
        raise refusal from error
