"""`start --push`: copies the files of a dataflow to its machines by rsync(1), as the caller.

rsync walks by path, and root must not follow what others can change meanwhile. So as root, on
either end, the whole directory has to be root's.
"""

import json
import os
import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path, PurePath

from dora_systemd.adapters.host.process import run_command
from dora_systemd.decisions.machines.member import Member
from dora_systemd.decisions.reload.watch_rules import NOT_OF_PROJECT
from dora_systemd.decisions.remote.hosts import Host
from dora_systemd.decisions.remote.ssh_failures import SSH_FAILED, last_line, unreached
from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.names import settings_path
from dora_systemd.terminal_text import short_line
from dora_systemd.trust.programs import check_program
from dora_systemd.trust.tree import strange_part
from dora_systemd.values import shown
from dora_systemd.verbs.machines.probe import ask_as_caller
from dora_systemd.verbs.start.plan import Plan

PLACE = "--place"
"""The option of `doractl member` that checks whether a directory may be written."""
INSTALL = "apt install rsync"
_LONGEST = 300
_SSH = (
    *("ssh", "-T", "-oBatchMode=yes", "-oLogLevel=ERROR", "-oConnectTimeout=8"),
    *("-oServerAliveInterval=5", "-oServerAliveCountMax=3"),
    *("-oClearAllForwardings=yes", "-oRemoteCommand=none"),
)
# No owner and no group: the account on the machine owns all files. No devices. No --delete: other
# files stay, in case that the directory was named by mistake.
_RSYNC = ("rsync", "--recursive", "--links", "--perms", "--times", "--mkpath", "--secluded-args")


def target_of(member: Member) -> str:
    """The directory of the dataflow file on the machine."""
    return str(PurePath(member.words[1]).parent)


def rsync_command(member: Member, dataflow: str) -> list[str]:
    """Return the command that copies the directory of the dataflow file to the machine.

    dataflow: absolute path of the file on this machine. The settings file is not copied, because
    its settings are those of the head.
    """
    host = member.host
    ssh = shlex.join([*_SSH, *([f"-p{host.port}"] if host.port else [])])
    settings = PurePath(settings_path(dataflow)).name
    left_out = [f"--exclude={one}" for one in (*NOT_OF_PROJECT, f"/{settings}")]
    target = f"{_bracketed(host)}:{target_of(member)}/"
    return [*_RSYNC, *left_out, f"--rsh={ssh}", "--", f"{PurePath(dataflow).parent}/", target]


def _bracketed(host: Host) -> str:
    """Put an IPv6 address into brackets: rsync takes two colons for the name of its daemon."""
    user, at, name = host.destination.rpartition("@")
    return f"{user}{at}[{name}]" if ":" in name else host.destination


def place_words(member: Member) -> tuple[str, ...]:
    """Return the arguments of doractl that check the member's directory on its machine."""
    return ("member", f"{PLACE}={target_of(member)}")


def format_place(problem: str, hint: str) -> str:
    """The answer, one line. problem: "" if files may be copied there."""
    return json.dumps({"problem": problem, "hint": hint})


def check_place(member: Member, answer: str) -> None:
    """Raise DoraSystemdError (BAD_INPUT) if the machine refuses a copy into the directory."""
    try:
        found = json.loads(answer.strip().splitlines()[-1])
        problem, hint = (short_line(str(found[key]), _LONGEST) for key in ("problem", "hint"))
    except (ValueError, TypeError, KeyError, IndexError, RecursionError):
        problem = "its answer cannot be read"
        hint = "both machines need the same version of dora-systemd"
    if problem:
        raise refusal(member, problem, hint)


def check_copied(member: Member, status: int, said: str) -> None:
    """Raise DoraSystemdError if rsync has failed. `said`: its standard error."""
    if status == SSH_FAILED:
        raise unreached(member.host, said)
    if status:
        raise refusal(member, _first_words(said) or f"rsync has the exit status {status}", "")


def _first_words(said: str) -> str:
    """The first line of rsync's errors: its last line reports only that there were some."""
    lines: Sequence[str] = [one for one in said.splitlines() if one.strip()]
    return last_line(lines[0]) if lines else ""


def refusal(member: Member, reason: str, hint: str) -> DoraSystemdError:
    """Return the error for a copy that failed, after which nothing is started."""
    return bad_input(f"cannot copy the dataflow to machine {member.machine}: {reason}", hint)


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
        message = f"cannot copy {shown(dataflow)}: all of its nodes run on this machine"
        raise usage_error(message, "leave out --push, or write deploy: {machine: NAME} at a node")
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
        raise bad_input(f"cannot copy {shown(str(directory))}: {reason}", hint)


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
