"""Starts programs that another user may have written; no other module starts processes for others.

- A program runs as the account that owns it, with that account's environment, so that no variable
  of root's gets there, and without the caller's keys.
- As root, and without an account, only those programs run that root alone can change, including all
  directories above them and their interpreters.
"""

import contextlib
import os
import pwd
import select
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import Thread
from typing import NamedTuple, TypeVar

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.paths import reached, user_name
from dora_systemd.values import shown

_User = TypeVar("_User", int, str)
DEFAULT_PATH = "/usr/local/bin:/usr/bin:/bin"
_LANGUAGE = "C.UTF-8"
_END_SECONDS = 2.0
_JOIN_SESSION_KEYRING = 1
_KEYCTL = {"x86_64": 250, "ppc64le": 271, "s390x": 280}
_KEYCTL_OF_32_BITS = {"x86_64": 288, "i686": 288, "aarch64": 311, "armv7l": 311, "armv6l": 311}
_KEYCTL_ELSEWHERE = 219
"""The number of keyctl(2), for which the C library has no function."""
_FIRST_LINE = 256
"""Bytes of the line "#!INTERPRETER" that the kernel reads, see execve(2)."""


class Account(NamedTuple):
    """The user that a program runs as, with all groups."""

    uid: int
    gid: int
    groups: tuple[int, ...] = ()
    name: str = ""
    home: str = "/"
    shell: str = "/bin/sh"


def account_from(entry: pwd.struct_passwd) -> Account:
    """The account of a passwd(5) entry."""
    groups = tuple(os.getgrouplist(entry.pw_name, entry.pw_gid))
    uid, gid = entry.pw_uid, entry.pw_gid
    return Account(uid, gid, groups, entry.pw_name, entry.pw_dir, entry.pw_shell)


def account_of_uid(uid: int) -> Account:
    """The account of a uid. Raises DoraSystemdError (NOT_FOUND) if the uid has no entry."""
    try:
        return account_from(pwd.getpwuid(uid))
    except (KeyError, OverflowError) as error:
        hint = "the user was deleted while the dataflow ran: stop it, or make that user again"
        message = f"cannot become the user with the uid {uid}: there is none"
        raise DoraSystemdError(message, hint, ExitCode.NOT_FOUND) from error


def require_user(uid: int, name: str) -> None:
    """Raise DoraSystemdError if a user was deleted, so that systemd starts nothing as that user.

    name: in $USER, which --env can change; "" if User= is a number.
    """
    if name and not _is_known(uid, pwd.getpwuid) and not _is_known(name, pwd.getpwnam):
        message = f"cannot start again as the user {shown(name)}: there is none any more"
        raise DoraSystemdError(message, "create that user again", ExitCode.NOT_FOUND)


def _is_known(user: _User, find: Callable[[_User], object]) -> bool:
    try:
        find(user)
    except (KeyError, OverflowError):
        return False
    return True


def own_account() -> Account:
    """The account of this process; in the cell of a dataflow that is enough, even for root."""
    uid = os.geteuid()
    return Account(uid, os.getegid(), tuple(os.getgroups()), user_name(uid))


def fresh_environment(account: Account) -> dict[str, str]:
    """The environment of the account's programs, as after a login, without the caller's."""
    return {
        "HOME": account.home,
        "USER": account.name,
        "LOGNAME": account.name,
        "SHELL": account.shell or "/bin/sh",
        "PATH": DEFAULT_PATH,
        "LANG": _LANGUAGE,
    }


def spawn(
    command: Sequence[str],
    account: Account | None,
    environment: Mapping[str, str] | None = None,
    directory: str | None = None,
    stdin: int = subprocess.DEVNULL,
    stderr: int = subprocess.PIPE,
) -> "subprocess.Popen[bytes]":
    """Start a child process in a new session, with no file descriptors but its streams.

    account: the user that it runs as; None: the caller, and then root may run only root's own
    programs. environment: the complete environment; None: that of the account, or the caller's if
    there is no account. Raises OSError, and DoraSystemdError (NO_PERMISSION) for a program that
    root must not run.
    """
    if account is None:
        check_program(command[0])
    elif environment is None:
        environment = fresh_environment(account)
    other = account if account is not None and account.uid != os.geteuid() else None

    def start() -> "subprocess.Popen[bytes]":
        return subprocess.Popen(
            command,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=stderr,
            env=environment,
            cwd=directory,
            start_new_session=True,
            user=None if other is None else other.uid,
            group=None if other is None else other.gid,
            extra_groups=None if other is None else other.groups,
        )

    return start() if other is None else _without_keys(start)


def _without_keys(start: "Callable[[], subprocess.Popen[bytes]]") -> "subprocess.Popen[bytes]":
    """Call `start` in a thread that has left the keys of the caller. Raises what that raises."""
    found: list[subprocess.Popen[bytes]] = []
    errors: list[BaseException] = []

    def run() -> None:
        leave_keys()
        try:
            found.append(start())
        except BaseException as error:  # whatever it is, the caller gets it
            errors.append(error)

    thread = Thread(target=run)
    thread.start()
    thread.join()
    if errors:
        raise errors[0]
    return found[0]


def leave_keys() -> None:
    """Give this thread, and what it starts, an empty session keyring, see session-keyring(7).

    A program possesses the keys of the one that starts it, whatever user it becomes: root's, or by
    sudo(8) those of the caller, such as tickets of Kerberos. A container may refuse this, with all
    other calls for keys.
    """
    # Imported late: few verbs start programs of others.
    import ctypes

    machine, is_wide = os.uname().machine, sys.maxsize > 2**32
    number = (_KEYCTL if is_wide else _KEYCTL_OF_32_BITS).get(machine, _KEYCTL_ELSEWHERE)
    ctypes.CDLL(None).syscall(ctypes.c_long(number), ctypes.c_long(_JOIN_SESSION_KEYRING), None)


def end_child(child: "subprocess.Popen[bytes]") -> None:
    """Kill a child process, close its streams, and wait for its end as long as that is sure.

    A child of another account may be traced by that account. The kernel then reports the end to the
    tracer first, which may never fetch it, see ptrace(2). The child may also be inside of a mount
    that hangs. Such a child stays a zombie until we end.
    """
    child.kill()
    for stream in (child.stdin, child.stdout, child.stderr):
        if stream:
            with contextlib.suppress(OSError):  # the first may still have bytes for it
                stream.close()
    if child.returncode is None:
        poll, ended = select.poll(), os.pidfd_open(child.pid)
        poll.register(ended, select.POLLIN)
        poll.poll(_END_SECONDS * 1000)
        os.close(ended)
        child.poll()


def become(account: Account) -> None:
    """Change this process to the account; there is no way back. Raises OSError."""
    if account.uid != os.geteuid():
        leave_keys()
        os.setgroups(account.groups)
        os.setgid(account.gid)
        os.setuid(account.uid)


def check_program(program: str) -> None:
    """Raise DoraSystemdError (NO_PERMISSION) if root would run a program that others can change.

    program: a path, or a name to look up in PATH. A missing program passes: starting it reports
    that.
    """
    if os.geteuid() != 0:
        return
    found: str | None = program
    for _ in range(3):  # a script, "env" in its first line, and the program that env finds
        found = found if found and "/" in found else _which(found or "")
        if found is None or not os.path.lexists(found):
            return
        found = _interpreter(str(Path(found).absolute()))
        if found is None:
            return
    raise _refusal(program, "its interpreter is a script of a script")


def _which(name: str) -> str | None:
    """The program that execvp(3) would run. Not shutil.which(), which loads every compressor."""
    paths = (str(Path(place, name)) for place in os.get_exec_path())
    return next((one for one in paths if Path(one).is_file() and os.access(one, os.X_OK)), None)


def _interpreter(program: str) -> str | None:
    """A script's interpreter, None for a binary. Raises DoraSystemdError if it is not root's."""
    with reached(program) as (found, place):
        if not place.is_roots:
            owner = next((uid for uid in sorted(place.owners) if uid != 0), None)
            who = "others" if owner is None else user_name(owner)
            raise _refusal(program, f"{who} can change it")
        with Path(f"/proc/self/fd/{found}").open("rb") as file:
            words = file.read(_FIRST_LINE).partition(b"\n")[0]
    if not words.startswith(b"#!"):
        return None
    interpreter, *more = os.fsdecode(words[2:]).split() or [""]
    is_env = Path(interpreter).name == "env"
    return next((one for one in more if not one.startswith("-")), None) if is_env else interpreter


def _refusal(program: str, reason: str) -> DoraSystemdError:
    return DoraSystemdError(
        f"cannot run {shown(program)} as root: {reason}",
        "run it as its owner, or have it installed by root",
        ExitCode.NO_PERMISSION,
    )
