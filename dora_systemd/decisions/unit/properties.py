"""Builds the unit of a dataflow with one small pure function for each concern.

Keys are those of unit files; the values have the types of StartTransientUnit.
"""

import signal
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from dora_systemd.decisions.cell.environment import checked_variable, environment_entries
from dora_systemd.decisions.cell.options import (
    RunnerOptions,
    post_command,
    reload_command,
    runner_command,
)
from dora_systemd.decisions.cell.restarts import restart_of
from dora_systemd.decisions.cell.rights import NICE_LIMIT, NodeRights, rights_of
from dora_systemd.decisions.life.runner_exit import RunnerExit
from dora_systemd.decisions.life.stop_budget import unit_timeout
from dora_systemd.decisions.needs.units import NETWORK_UNIT, device_entries, needs_properties
from dora_systemd.decisions.needs.words import needs_of
from dora_systemd.decisions.properties.assignments import (
    NOTHING_NEWER,
    Newer,
    Properties,
    format_property,
    parse_line,
    typed,
    with_assignments,
    with_properties,
)
from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.sandbox import Sandbox, sandbox_properties
from dora_systemd.decisions.properties.structs import Command
from dora_systemd.decisions.properties.table import TABLE
from dora_systemd.decisions.settings.limits import REALTIME
from dora_systemd.decisions.settings.needs import NEEDS
from dora_systemd.decisions.settings.resolve import Settings
from dora_systemd.decisions.settings.sandbox import credential_properties
from dora_systemd.decisions.settings.table import PROPERTY
from dora_systemd.decisions.unit.file import format_sections
from dora_systemd.errors import DoraSystemdError, ExitCode, usage_error
from dora_systemd.names import SLICE, notice_hold_unit, notice_unit, release_of, unit_description
from dora_systemd.scope import NOTICE_NAME, RUNTIME_NAME
from dora_systemd.values import INFINITY, SECOND, quoted

WATCHDOG = 30 * SECOND

START_MARGIN = 10 * SECOND
"""What TimeoutStartSec= allows in addition to the delay before a restart and --start-timeout, which
the runner measures itself."""

_ENDS_OF_ATTACHED = (RunnerExit.OK, RunnerExit.FAILED_AT_STOP)


class UnitContext(NamedTuple):
    """Values for the unit besides the runner's options."""

    python: str  # absolute path of the interpreter that runs dora-systemd itself
    is_user: bool  # whether the unit is one of a user's manager
    user: str | None = None  # User= in system scope; None runs everything as root
    # all of Environment=, see unit_environment
    environment: Mapping[str, str] = {}
    credentials: Mapping[str, str] = {}  # absolute path by name
    sandbox: Sandbox | None = None  # None for no sandbox
    clock: str = ""  # the service that waits for the right time, or ""
    newer: Newer = NOTHING_NEWER  # what judges a --property that the table does not know


def unit_properties(
    options: RunnerOptions, context: UnitContext, settings: Settings
) -> dict[str, Property]:
    """Every property of the unit by key: ours, those of settings, and --property, which overrides.

    Raises DoraSystemdError (USAGE) for a property that cannot be set, and for a user other than the
    caller in user scope.
    """
    own = {
        **service_properties(options, context),
        **stop_properties(options),
        **restart_properties(options),
        **cgroup_properties(),
        **directory_properties(options),
        **environment_properties(context),
        **credential_properties(context.credentials),
        **user_properties(context),
        **log_properties(options, context),
        **ring_properties(options),
        **(sandbox_properties(context.sandbox) if context.sandbox else {}),
        **realtime_properties(settings),
        **rights_properties(rights_of(options)),
        **needs_properties(settings[NEEDS], context.clock),
        **device_properties(options, context),
    }
    own = with_properties(own, notice_properties(options))
    properties = with_properties(own, settings_properties(settings))
    of_machines = address_properties(options.addresses, context.is_user)
    properties = with_properties(properties, of_machines)
    assignments = settings[PROPERTY]
    try:
        return with_assignments(properties, assignments, context.newer)
    except DoraSystemdError as error:
        message = f"{error.message} ({settings.source(PROPERTY)})"
        code = ExitCode.BAD_INPUT if settings.is_in_file(PROPERTY) else error.code
        raise DoraSystemdError(message, error.hint, code) from error


def format_unit(properties: Properties) -> str:
    """The properties as a unit file, see systemd.unit(5) and systemd.service(5)."""
    sections: dict[str, list[str]] = {"Unit": [], "Service": []}
    for slot in properties:
        row = TABLE.get(slot.removesuffix("~"))
        section = row.section if row else "Service"
        sections[section] += format_property(slot, properties)
    return format_sections(sections)


def service_properties(options: RunnerOptions, context: UnitContext) -> dict[str, Property]:
    """The runner as the main process of a Type=notify service, see systemd.service(5)."""
    pause = 0 if restart_of(options).policy == "no" else restart_of(options).max_delay
    # The runner reports late nodes itself; systemd's timeout is for a runner that hangs.
    most = min(pause + options.start_timeout + START_MARGIN, INFINITY)
    return typed(
        Description=unit_description(options.name, options.uuid, release_of(options.dataflow)),
        Slice=SLICE,
        Type="notify",
        NotifyAccess="main",
        ExecStart=_command(runner_command(context.python, options)),
        ExecStopPost=_command(post_command(context.python, options), "ignore-failure"),
        ExecReload=_command(reload_command(context.python)),
        # Two pipes for each node, so that their content survives a kill of the runner.
        FileDescriptorStoreMax=4096,
        # Never the project: Python could find its modules before the runner's.
        WorkingDirectory="/",
        TimeoutStartSec=most,
        WatchdogSec=WATCHDOG,
        # An OOM kill of one node must not end the others; the runner reports it.
        OOMPolicy="continue",
    )


def _command(argv: Sequence[str], *flags: str) -> Sequence[Command]:
    # ":" in a unit file: a "$" in a path stays as it is.
    return ((argv[0], tuple(argv), (*flags, "no-env-expand")),)


def ring_properties(options: RunnerOptions) -> dict[str, Property]:
    """Keep the ring of the recorder when the unit has finally failed, for the bundle after that.

    The runner has systemd close all of it when the unit ends in another way, see fd_store.py.
    """
    has_ring = options.has("record") and options.of_dataflow("record") is not None
    return typed(FileDescriptorStorePreserve="yes") if has_ring else {}


def stop_properties(options: RunnerOptions) -> dict[str, Property]:
    """Properties of the stop: SIGTERM for the runner, which stops dora; later SIGKILL for all.

    See systemd.kill(5).

    dora kills a node at 1.5 times its grace duration; a setting `stop` has stop_limit.
    """
    return typed(KillMode="mixed", TimeoutStopSec=unit_timeout(options))


def restart_properties(options: RunnerOptions) -> dict[str, Property]:
    """Automatic restarts, see systemd.service(5) and StartLimitBurst= in systemd.unit(5)."""
    policy = restart_of(options)
    # A restart does not help nodes that dora gave up, or a dataflow that is refused. An attached
    # dataflow that has finished stays finished.
    refused = (RunnerExit.BAD_DATAFLOW, RunnerExit.NO_ACCESS, RunnerExit.NO_DORA)
    apart = (RunnerExit.NO_MACHINE, RunnerExit.STOPPED_ON_MACHINE) if options.placed else ()
    final = (
        RunnerExit.NODES_FAILED,
        RunnerExit.RESTARTS_SPENT,
        *refused,
        *apart,
        *(_ENDS_OF_ATTACHED if options.attached else ()),
    )
    common = typed(
        RestartPreventExitStatus=(tuple(sorted(map(int, final))), ()),
        # The signal of the watchdog: that the runner hangs does not mean that its nodes failed.
        RestartForceExitStatus=((), (int(signal.SIGABRT),)),
    )
    if policy.policy == "no":
        return common | typed(Restart="no")
    is_endless = policy.max_restarts == INFINITY
    return common | typed(
        Restart=policy.policy,
        # The runner waits for the rest of the delay, see runner/cell/restarts.py: RestartSteps=
        # would count restarts forever.
        RestartSec=policy.unit_delay,
        StartLimitIntervalSec=0 if is_endless else policy.window,
        StartLimitBurst=1 if is_endless else policy.unit_burst,
    )


def cgroup_properties() -> dict[str, Property]:
    """A delegated cgroup with accounting and without limits, see systemd.resource-control(5).

    CPU time is always accounted for: systemd 262 has no CPUAccounting= any more.
    TasksMax=infinity: systemd's default would be an implicit limit. LimitMEMLOCK=infinity, see
    systemd.exec(5): each node of dora locks 8 MiB of shared memory for messages. With systemd's
    default of 8 MiB in total nodes fall back to copying. A user's manager can only grant its own
    limit.
    """
    return typed(
        Delegate=True,
        DelegateSubgroup="supervisor",
        MemoryAccounting=True,
        TasksAccounting=True,
        IOAccounting=True,
        TasksMax=INFINITY,
    ) | parse_line("LimitMEMLOCK", "infinity")


def directory_properties(options: RunnerOptions) -> dict[str, Property]:
    """The cell's own directory below /run, removed when the unit ends, see systemd.exec(5)."""
    return typed(RuntimeDirectory=(f"{RUNTIME_NAME}/{options.name}",), RuntimeDirectoryMode=0o700)


def notice_properties(options: RunnerOptions) -> dict[str, Property]:
    """What starts the notice of a failure: a failure of the unit, and a request of the runner.

    The request is a file in a directory of the runner. Its parent is root's: systemd follows links
    when it watches a path, so the runner must not be able to replace any part of that path.
    """
    if not options.is_noticed:
        return {}
    return typed(
        # Apart: a reference of the service would keep the dataflow loaded as long as that runs.
        OnFailure=(notice_unit(options.name), notice_hold_unit(options.name)),
        Wants=(notice_unit(options.name, ".path"),),
        RuntimeDirectory=(f"{NOTICE_NAME}/{options.name}",),
    )


def environment_properties(context: UnitContext) -> dict[str, Property]:
    """Environment= from unit_environment; the values are literal, including "$" and "%"."""
    for key, value in context.environment.items():
        checked_variable(key, value)
    return typed(Environment=environment_entries(context.environment))


def user_properties(context: UnitContext) -> dict[str, Property]:
    """User= in system scope; a user's manager runs everything as that user."""
    if context.user is None:
        return {}
    if context.is_user:
        message = f"cannot run as the user {quoted(context.user)} in user scope"
        raise usage_error(message, "leave --uid out or add --system")
    return typed(User=context.user)


def log_properties(options: RunnerOptions, context: UnitContext) -> dict[str, Property]:
    """The journal. The last two have no effect in a user's manager, see systemd.exec(5)."""
    common = typed(StandardOutput="journal", StandardError="journal", SyslogIdentifier=options.name)
    if context.is_user:
        return common
    fields = (f"DORA_DATAFLOW={options.uuid}", f"DORA_DATAFLOW_NAME={options.name}")
    return common | typed(
        LogExtraFields=tuple(field.encode() for field in fields),
        # A limit that is never reached: systemd 257 does not pass 0 on to journald, which then
        # applies its own.
        LogRateLimitIntervalSec=SECOND,
        LogRateLimitBurst=500_000_000,
    )


def settings_properties(settings: Settings) -> dict[str, Property]:
    """The properties of settings with a `property` and a value, such as MemoryMax=."""
    given = [one for one in settings.table if one.property and settings[one] != one.default]
    texts = (f"{one.property}={text}" for one in given for text in one.kind.format(settings[one]))
    return with_assignments({}, texts)


def device_properties(options: RunnerOptions, context: UnitContext) -> dict[str, Property]:
    """DeviceAllow= for the devices that nodes wait for, where the sandbox closes all others."""
    if context.sandbox is None or not context.sandbox.has_mounts:
        return {}
    return with_assignments({}, [f"DeviceAllow={one}" for one in device_entries(needs_of(options))])


def realtime_properties(settings: Settings) -> dict[str, Property]:
    """CPUSchedulingPolicy= and its priority, see systemd.exec(5) and sched(7)."""
    given = settings[REALTIME]
    if given is None:
        return {}
    policy, _, priority = given.partition(":")
    texts = (f"CPUSchedulingPolicy={policy}", f"CPUSchedulingPriority={priority}")
    return with_assignments({}, texts)


def rights_properties(rights: Sequence[NodeRights]) -> dict[str, Property]:
    """LimitRTPRIO=, LimitNICE= and OOMScoreAdjust=; the launcher takes them from the other nodes.

    The runner and dora keep them. Without dora there is no node, so its memory goes last as well.
    """
    priority = max((one.priority for one in rights), default=0)
    nice = min((one.nice or 0 for one in rights), default=0)
    oom = min((one.oom_score_adjust or 0 for one in rights), default=0)
    texts = {
        "LimitRTPRIO": priority,
        "LimitNICE": NICE_LIMIT - nice if nice < 0 else 0,
        "OOMScoreAdjust": min(oom, 0),
    }
    return with_assignments({}, [f"{key}={number}" for key, number in texts.items() if number])


def address_properties(addresses: Sequence[str], is_user: bool) -> dict[str, Property]:
    """Packets to and from these machines only, see systemd.resource-control(5).

    addresses: of all machines; () if they do not meet like this. A user's manager can neither
    filter packets nor wait for the network.
    """
    if not addresses or is_user:
        return {}
    lines = ["IPAddressDeny=any", "IPAddressAllow=localhost"]
    lines += [f"IPAddressAllow={one}" for one in addresses]
    lines += [f"{key}={NETWORK_UNIT}" for key in ("Wants", "After")]
    return with_assignments({}, lines)
