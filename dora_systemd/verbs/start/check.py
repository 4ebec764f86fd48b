"""Checks a dataflow without starting it, and runs dora commands about it.

As root this happens in a unit of its own, with the user, sandbox and environment of the dataflow's
unit, so that root does not run a dora that another user can change. For other callers it happens
directly.
"""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from dora_systemd.adapters.bus.manager import Manager
from dora_systemd.adapters.bus.manager import Property as Sent
from dora_systemd.adapters.dora.command import DORA_SECONDS
from dora_systemd.adapters.host.process import Completed, beside, read_streams, run_command
from dora_systemd.decisions.cell.exits import exit_of
from dora_systemd.decisions.cell.options import check_command
from dora_systemd.decisions.life.refusal import parse_refusal
from dora_systemd.decisions.properties.assignments import typed
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.releases.program_versions import parse_versions
from dora_systemd.errors import DoraSystemdError
from dora_systemd.trust.programs import own_account
from dora_systemd.values import SECOND, shown
from dora_systemd.verbs.facts.reason import exit_status, failure_reason
from dora_systemd.verbs.start.plan import Plan
from dora_systemd.verbs.start.unit import plan_properties

_FORBIDDEN = 200
"""Exit statuses from this one on are systemd's own, see systemd.exec(5)."""
_OF_RUNNERS = (
    *("Exec", "Restart", "StartLimit", "RuntimeDirectory", "Watchdog", "FileDescriptorStore"),
    *("Delegate", "LogExtraFields", "Type", "Timeout", "OOMPolicy", "Notify", "OnFailure"),
)
"""Prefixes of the properties that only apply to a runner: a failed check sends no notice."""


def check_plan(connect: Callable[[], Manager], plan: Plan) -> dict[str, str]:
    """The versions of dora and Python, by name, as far as the check knows them.

    Raises DoraSystemdError for what the runner would refuse at its start.
    """
    command = check_command(sys.executable, plan.options)
    done = run_beside(connect, plan, command)
    if refusal := parse_refusal(done.stdout, done.status):
        raise refusal
    if done.status:
        raise _no_check(plan, done.stderr.strip() or str(exit_of(done.status)))
    return parse_versions(done.stdout)


def check_unit(connect: Callable[[], Manager], plan: Plan) -> None:
    """Raise DoraSystemdError for what systemd cannot do at a start, if it can be reached."""
    if os.geteuid() == 0:
        return  # check_plan() starts a unit with these properties
    try:
        manager = connect()
    except DoraSystemdError:
        return
    plan_properties(plan, manager)


def run_beside(connect: Callable[[], Manager], plan: Plan, command: Sequence[str]) -> Completed:
    """Run a command as the runner of `plan` would. Raises DoraSystemdError if that fails."""
    if os.geteuid() != 0:
        environment = {**os.environ, **plan.environment}
        account, directory = own_account(), str(Path(plan.options.dataflow).parent)
        return run_command(command, DORA_SECONDS, environment, directory, account)
    return _run_unit(connect(), plan, command)


def _run_unit(manager: Manager, plan: Plan, command: Sequence[str]) -> Completed:
    unit = f"doractl-check-{os.urandom(8).hex()}.service"
    reading, writing = zip(*(os.pipe2(os.O_CLOEXEC) for _ in range(2)), strict=True)
    streams = beside(lambda: read_streams(reading, DORA_SECONDS + 5))
    try:
        manager.start_transient(unit, _properties(manager, plan, command, writing), None, True)
    finally:
        for fd in writing:
            os.close(fd)
        stdout, stderr = streams.result()
    status = exit_status(manager, unit)
    if status is None or status >= _FORBIDDEN:
        raise _no_check(plan, failure_reason(manager, unit))
    return Completed(status, stdout.decode(errors="replace"), stderr.decode(errors="replace"))


def _properties(
    manager: Manager, plan: Plan, command: Sequence[str], streams: Sequence[int]
) -> list[Sent]:
    """The dataflow's unit properties, for a command; the unit disappears with this client."""
    kept = beside_properties(manager, plan)
    kept |= typed(Type="oneshot", TimeoutStartSec=int(DORA_SECONDS) * SECOND)
    for key in ("StandardOutput", "StandardError"):
        del kept[key]
    stdout, stderr = streams
    return [
        *kept.values(),
        exec_start(command),
        ("StandardOutputFileDescriptor", "h", stdout),
        ("StandardErrorFileDescriptor", "h", stderr),
        ("CollectMode", "s", "inactive-or-failed"),
        ("AddRef", "b", True),
    ]


def beside_properties(manager: Manager, plan: Plan) -> dict[str, Property]:
    """The dataflow's unit properties, by slot, for a unit that has no runner.

    The directory of the cell exists only while the cell runs, and may then be that of another
    dataflow with this name.
    """
    properties, _ = plan_properties(plan, manager)
    kept = {key: one for key, one in properties.items() if not key.startswith(_OF_RUNNERS)}
    if binds := kept.pop("BindPaths", None):
        cell = str(plan.scope.cell_directory(plan.options.name))
        others = tuple(one for one in binds.value if one[0] != cell)
        kept |= {"BindPaths": binds._replace(value=others)} if others else {}
    return kept


def exec_start(command: Sequence[str]) -> Sent:
    """ExecStart= as it is sent.

    systemd 252 cannot read ExecStartEx back at a reload, so this is ExecStart, with "$" as "$$".
    """
    words = tuple(word.replace("$", "$$") for word in command)
    return "ExecStart", "a(sasb)", ((command[0], words, False),)


def _no_check(plan: Plan, reason: str) -> DoraSystemdError:
    return DoraSystemdError(f"cannot check {shown(plan.options.dataflow)}: {reason}")
