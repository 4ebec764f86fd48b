"""`start --push`: copies the files of a dataflow to its machines, as the caller.

rsync walks by path, and root must not follow what others can change meanwhile. So as root, on
either end, the whole directory has to be root's.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from dora_systemd.adapters.host.process import run_command
from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.machines.push import (
    INSTALL,
    check_copied,
    check_place,
    place_words,
    refusal,
    rsync_command,
    target_of,
)
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.trust.programs import check_program
from dora_systemd.trust.tree import strange_part
from dora_systemd.values import shown
from dora_systemd.verbs.machines.probe import ask_as_caller
from dora_systemd.verbs.start.plan import Plan

_SECONDS = 24 * 3600.0
"""Timeout of a copy. ssh ends a copy that makes no progress."""
_NONE = "rsync is not installed"


def push(
    plan: Plan,
    stage: Callable[[str], None],
    ask: Callable[[Host, Sequence[str]], str] = ask_as_caller,
) -> None:
    """Copy the directory of the dataflow to each member. stage: receives each step.

    `ask`: returns the output of doractl on a host. All machines are checked before the first copy.
    Raises DoraSystemdError.
    """
    dataflow = plan.options.dataflow
    if not plan.members:
        hint = "leave out --push, or write deploy: {machine: NAME} at a node"
        message = f"cannot copy {shown(dataflow)}: all of its nodes run on this machine"
        raise DoraSystemdError(message, hint, ExitCode.USAGE)
    _check_here(Path(dataflow).parent)
    for member in plan.members:
        stage(f"asking machine {member.machine}")
        check_place(member, ask(member.host, place_words(member)))
    for member in plan.members:
        stage(f"copying files to machine {member.machine}, {target_of(member)}")
        _copy(member, dataflow)


def _check_here(directory: Path) -> None:
    if problem := place_problem(directory, "as the user of the nodes: doractl --user start"):
        reason, hint = problem
        message = f"cannot copy {shown(str(directory))}: {reason}"
        raise DoraSystemdError(message, hint, ExitCode.BAD_INPUT)


def _copy(member: Member, dataflow: str) -> None:
    command = rsync_command(member, dataflow)
    try:
        done = run_command(command, _SECONDS)
    except DoraSystemdError as error:
        raise refusal(member, error.message, error.hint) from error
    check_copied(member, done.status, done.stderr)


def place_problem(directory: Path, way_out: str) -> tuple[str, str] | None:
    """Return why this account cannot copy from or to a directory of this machine, and a hint.

    way_out: for root, if the directory is not root's.
    """
    if shutil.which("rsync") is None:
        return f"{_NONE} on {os.uname().nodename}", f"there: {INSTALL}"
    check_program("ssh")  # which rsync looks up in PATH
    if os.geteuid() == 0 and (strange := strange_part(directory)):
        return strange, f"root only copies what is root's; {way_out}"
    return None
