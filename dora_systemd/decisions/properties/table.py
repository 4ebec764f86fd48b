"""The table of unit properties: every one that `--property` can set, with its name on D-Bus.

Names, types and sections are those of org.freedesktop.systemd1(5), systemd.unit(5),
systemd.service(5), systemd.exec(5), systemd.kill(5) and systemd.resource-control(5).

systemd-run(1) converts texts too, but cannot replace this table. Tried with systemd 257 and 324
keys, each with a good value and four bad ones:

- It has no dry run. `systemd-analyze verify` exits with 0 and prints values of Environment=.
- It refuses good values that D-Bus and unit files take, such as PrivateUsers=identity of our
  sandbox, PrivateTmp=disconnected, two addresses in IPAddressAllow=, and StartupMemoryMax=.
- A quarter of its refusals do not name the key, and none lists the valid values.
- It passes on a line break in Description=: the unit file has one more line, with any key.
- All users see its command line. In a user's manager, nobody else sees Environment= otherwise.
  One argument has at most 128 KiB.
- A start takes 30 ms instead of 11 ms (medians of 20, on a busy machine).
- systemd 252 refuses newer keys, which `unit/systemd_versions.py` leaves out with a warning.
- `enable` compares values: 90s is 1min 30s.

The types that systemd reports on D-Bus cannot replace it either. Tried with systemd 257: 248 of 333
keys have their type there, 85 have another one or none, such as ExecStartEx and MemoryMaxScale. A
type has no words, no units and no limits. What would go are the lists of names below, about 80
lines, and the build would need a running systemd.
"""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from dora_systemd.decisions.properties import kinds, lists, numbers, structs
from dora_systemd.decisions.properties.kinds import PropertyKind, choice_kind, number_kind
from dora_systemd.decisions.properties.lists import condition_kind

TABLE_VERSION = 257
"""The version of systemd whose properties and words these are."""

UNIT = "Unit"
SERVICE = "Service"


class Row(NamedTuple):
    """One key of a unit file: its section, and the D-Bus names and kinds of its values.

    The first kind that accepts a text determines the property.
    """

    key: str
    section: str
    choices: Sequence[tuple[str, PropertyKind]]


_ACTIONS = choice_kind(
    *("none", "reboot", "reboot-force", "reboot-immediate", "poweroff", "poweroff-force"),
    *("poweroff-immediate", "exit", "exit-force", "soft-reboot", "soft-reboot-force"),
    *("kexec", "kexec-force", "halt", "halt-force", "halt-immediate"),
)
_OUTPUTS = choice_kind(
    *("inherit", "null", "tty", "journal", "kmsg", "journal+console", "kmsg+console", "socket")
)
_RESTARTS = choice_kind(
    *("no", "on-success", "on-failure", "on-abnormal", "on-watchdog", "on-abort", "always")
)
_JOB_MODES = choice_kind("fail", "replace", "replace-irreversibly", "isolate", "flush")
_NUMBER = number_kind("u", 0, 2**32 - 1)

_BOOLS = """
    CPUAccounting MemoryAccounting IOAccounting TasksAccounting IPAccounting NoNewPrivileges
    PrivateDevices PrivateNetwork PrivateMounts PrivateIPC ProtectKernelTunables
    ProtectKernelModules ProtectKernelLogs ProtectClock ProtectHostname MemoryDenyWriteExecute
    RestrictRealtime RestrictSUIDSGID LockPersonality DynamicUser RemoveIPC MountAPIVFS
    CPUSchedulingResetOnFork IgnoreSIGPIPE SyslogLevelPrefix SendSIGHUP SendSIGKILL TTYReset
    TTYVHangup TTYVTDisallocate RootDirectoryStartOnly RemainAfterExit RootEphemeral MemoryKSM
    SetLoginEnvironment CoredumpReceive MemoryZSwapWriteback BindLogSockets Delegate
"""
_TEXTS = """
    User Group PAMName Slice TTYPath RootDirectory RootImage RootVerity SyslogIdentifier
    SELinuxContext Personality NetworkNamespacePath IPCNamespacePath LogNamespace
    UtmpIdentifier RootImagePolicy MountImagePolicy ExtensionImagePolicy Type NotifyAccess
    KillMode DelegateSubgroup WorkingDirectory
"""
_WORDS = """
    ReadWritePaths ReadOnlyPaths InaccessiblePaths ExecPaths NoExecPaths ExtensionDirectories
    ConfigurationDirectory StateDirectory CacheDirectory LogsDirectory RuntimeDirectory
    SupplementaryGroups SystemCallArchitectures PassEnvironment UnsetEnvironment
    DisableControllers IPIngressFilterPath IPEgressFilterPath ImportCredential
"""
_MODES = """
    UMask RuntimeDirectoryMode StateDirectoryMode CacheDirectoryMode LogsDirectoryMode
    ConfigurationDirectoryMode
"""
_FILTERS = """
    RestrictNetworkInterfaces RestrictAddressFamilies RestrictFileSystems SystemCallFilter
    SystemCallLog
"""
_UNIT_BOOLS = """
    StopWhenUnneeded RefuseManualStart RefuseManualStop AllowIsolate IgnoreOnIsolate
    DefaultDependencies SurviveFinalKillSignal
"""
_UNIT_WORDS = """
    Requires Requisite Wants BindsTo PartOf Upholds Conflicts Before After OnSuccess OnFailure
    PropagatesReloadTo ReloadPropagatedFrom PropagatesStopTo StopPropagatedFrom
    JoinsNamespaceOf RequiresMountsFor WantsMountsFor Documentation
"""
_DURATIONS = """
    RestartSec RestartMaxDelaySec TimeoutStartSec TimeoutStopSec TimeoutAbortSec RuntimeMaxSec
    RuntimeRandomizedExtraSec WatchdogSec LogRateLimitIntervalSec CPUQuotaPeriodSec
    MemoryPressureThresholdSec ManagedOOMMemoryPressureDurationSec
"""
_MEMORY_LIMITS = """
    MemoryMin MemoryLow MemoryHigh MemoryMax MemorySwapMax MemoryZSwapMax
    DefaultMemoryMin DefaultMemoryLow
"""
_SIZES = """
    StartupMemoryLow StartupMemoryHigh StartupMemoryMax StartupMemorySwapMax
    StartupMemoryZSwapMax DefaultStartupMemoryLow
"""
_SIZE_RLIMITS = "FSIZE DATA STACK CORE RSS AS MEMLOCK MSGQUEUE"
_COUNT_RLIMITS = "NOFILE NPROC LOCKS SIGPENDING NICE RTPRIO"
_RLIMIT_KINDS = {
    **dict.fromkeys(_SIZE_RLIMITS.split(), kinds.SIZE_LIMIT),
    **dict.fromkeys(_COUNT_RLIMITS.split(), kinds.COUNT_LIMIT),
    "CPU": kinds.SECONDS,
    "RTTIME": kinds.MICROSECONDS,
}
_COMMANDS = "ExecCondition ExecStartPre ExecStart ExecStartPost ExecReload ExecStop ExecStopPost"
_CONDITIONS = """
    Architecture Firmware Virtualization Host KernelCommandLine KernelVersion Credential
    Environment Security Capability ACPower NeedsUpdate FirstBoot PathExists PathExistsGlob
    PathIsDirectory PathIsSymbolicLink PathIsMountPoint PathIsReadWrite PathIsEncrypted
    DirectoryNotEmpty FileNotEmpty FileIsExecutable User Group ControlGroupController Memory CPUs
    CPUFeature OSRelease MemoryPressure CPUPressure IOPressure
"""

_SERVICE_KEYS: Sequence[tuple[PropertyKind, str]] = (
    (kinds.BOOL, _BOOLS),
    (kinds.TEXT, _TEXTS),
    (lists.WORDS, _WORDS),
    (kinds.MODE, _MODES),
    (kinds.DURATION, _DURATIONS),
    (structs.LATENCIES, "IODeviceLatencyTargetSec"),
    (kinds.SIZE_LIMIT, _SIZES),
    (kinds.CPU_WEIGHT, "CPUWeight StartupCPUWeight"),
    (kinds.WEIGHT, "IOWeight StartupIOWeight"),
    (structs.CPUS, "AllowedCPUs StartupAllowedCPUs NUMAMask"),
    (structs.CPUS, "AllowedMemoryNodes StartupAllowedMemoryNodes"),
    (numbers.NUMA_POLICY, "NUMAPolicy"),
    (choice_kind("auto", "closed", "strict"), "DevicePolicy"),
    (structs.DEVICES, "DeviceAllow"),
    (structs.WEIGHTS, "IODeviceWeight"),
    (structs.BANDWIDTHS, "IOReadBandwidthMax IOWriteBandwidthMax IOReadIOPSMax IOWriteIOPSMax"),
    (structs.ADDRESSES, "IPAddressAllow IPAddressDeny"),
    (structs.PROGRAMS, "BPFProgram"),
    (lists.FILTER, _FILTERS),
    (choice_kind("auto", "kill"), "ManagedOOMSwap ManagedOOMMemoryPressure"),
    (kinds.SHARE, "ManagedOOMMemoryPressureLimit"),
    (choice_kind("none", "avoid", "omit"), "ManagedOOMPreference"),
    (choice_kind("no", "yes", "auto", "skip"), "MemoryPressureWatch"),
    (lists.SEARCH_PATH, "ExecSearchPath"),
    (lists.ENVIRONMENT, "Environment"),
    (choice_kind("no", "yes", "full", "strict"), "ProtectSystem"),
    (choice_kind("no", "yes", "read-only", "tmpfs"), "ProtectHome"),
    (choice_kind("default", "noaccess", "invisible", "ptraceable"), "ProtectProc"),
    (choice_kind("all", "pid"), "ProcSubset"),
    (choice_kind("no", "yes"), "PrivatePIDs"),
    (choice_kind("inherit", "private", "shared"), "KeyringMode"),
    (choice_kind("init", "login", "user"), "UtmpMode"),
    (numbers.NAMESPACES, "RestrictNamespaces"),
    (numbers.ERROR_NUMBER, "SystemCallErrorNumber"),
    (numbers.CAPABILITIES, "CapabilityBoundingSet AmbientCapabilities"),
    (numbers.SECURE_BITS, "SecureBits"),
    (lists.PROFILE, "AppArmorProfile SmackProcessLabel"),
    (structs.BINDS, "BindPaths BindReadOnlyPaths"),
    (structs.MOUNTS, "TemporaryFileSystem"),
    (numbers.MOUNT_FLAGS, "MountFlags"),
    (structs.CREDENTIALS, "LoadCredential LoadCredentialEncrypted"),
    (number_kind("i", -20, 19), "Nice"),
    (number_kind("i", -1000, 1000), "OOMScoreAdjust"),
    (numbers.CPU_POLICY, "CPUSchedulingPolicy"),
    (number_kind("i", 0, 99), "CPUSchedulingPriority"),
    (numbers.IO_CLASS, "IOSchedulingClass"),
    (number_kind("i", 0, 7), "IOSchedulingPriority"),
    (kinds.NANOSECONDS, "TimerSlackNSec"),
    (numbers.LOG_LEVEL, "SyslogLevel LogLevelMax"),
    (numbers.FACILITY, "SyslogFacility"),
    (_NUMBER, "LogRateLimitBurst RestartSteps FileDescriptorStoreMax"),
    (lists.FIELDS, "LogExtraFields"),
    (lists.PATTERNS, "LogFilterPatterns"),
    (numbers.SIGNAL, "FinalKillSignal WatchdogSignal"),
    (_RESTARTS, "Restart"),
    (choice_kind("normal", "direct", "debug"), "RestartMode"),
    (choice_kind("main", "cgroup"), "ExitType"),
    (choice_kind("continue", "stop", "kill"), "OOMPolicy"),
    (choice_kind("terminate", "abort", "kill"), "TimeoutStartFailureMode TimeoutStopFailureMode"),
    (numbers.STATUSES, "SuccessExitStatus RestartPreventExitStatus RestartForceExitStatus"),
    (choice_kind("no", "yes", "restart"), "FileDescriptorStorePreserve"),
)
"""Keys of [Service] with the same name on D-Bus (but for Sec), by kind."""

_UNIT_KEYS: Sequence[tuple[PropertyKind, str]] = (
    (kinds.BOOL, _UNIT_BOOLS),
    (kinds.TEXT, "Description SourcePath RebootArgument JobTimeoutRebootArgument"),
    (lists.WORDS, _UNIT_WORDS),
    (kinds.DURATION, "JobRunningTimeoutSec StartLimitIntervalSec"),
    (_NUMBER, "StartLimitBurst"),
    (_ACTIONS, "StartLimitAction FailureAction SuccessAction JobTimeoutAction"),
    (number_kind("i", 0, 255), "FailureActionExitStatus SuccessActionExitStatus"),
    (_JOB_MODES, "OnFailureJobMode OnSuccessJobMode"),
    (choice_kind("inactive", "inactive-or-failed"), "CollectMode"),
)
"""Keys of [Unit] with the same name on D-Bus, by kind."""

_ODD: dict[str, Sequence[tuple[str, PropertyKind]]] = {
    "CPUQuota": [("CPUQuotaPerSecUSec", kinds.CPU_QUOTA)],
    "EnvironmentFile": [("EnvironmentFiles", structs.ENVIRONMENT_FILES)],
    "CPUAffinity": [
        ("CPUAffinityFromNUMA", kinds.word_kind("b", {"numa": True})),
        ("CPUAffinity", structs.CPUS),
    ],
}

_PLAIN = {
    "b": kinds.BOOL,
    "s": kinds.TEXT,
    "as": lists.WORDS,
    "i": number_kind("i", -(2**31), 2**31 - 1),
    "u": _NUMBER,
    "t": kinds.SIZE_LIMIT,
}
"""Kinds of properties that are not in the table, by type."""

_EXTENDED = {
    "PrivateTmp": choice_kind("disconnected"),
    "PrivateUsers": choice_kind("self", "identity", "full"),
    "ProtectControlGroups": choice_kind("private", "strict"),
}
"""Booleans at first; for later values there is a second property on D-Bus."""


def bus_name(key: str) -> str:
    """The usual name on D-Bus of a key: ...Sec is ...USec, except for TimerSlackNSec."""
    return re.sub("(?<!N)Sec$", "USec", key)


def plain_kind(key: str, signature: str) -> PropertyKind | None:
    """The kind of a property that is not in the table, by its type; None for other types."""
    is_duration = signature == "t" and key.endswith("Sec")
    return kinds.DURATION if is_duration else _PLAIN.get(signature)


def _plain_rows() -> Iterator[Row]:
    for section, rows in ((SERVICE, _SERVICE_KEYS), (UNIT, _UNIT_KEYS)):
        for kind, keys in rows:
            yield from (Row(key, section, [(bus_name(key), kind)]) for key in keys.split())


def _rows() -> Iterator[Row]:
    yield from _plain_rows()
    limits = {
        **dict.fromkeys(_MEMORY_LIMITS.split(), kinds.SIZE_LIMIT),
        "TasksMax": kinds.COUNT_LIMIT,
    }
    for key, kind in limits.items():
        yield Row(key, SERVICE, [(f"{key}Scale", kinds.SHARE), (key, kind)])
    for name, kind in _RLIMIT_KINDS.items():
        yield Row(f"Limit{name}", SERVICE, [(f"Limit{name}", kind)])
    for key in _COMMANDS.split():
        yield Row(key, SERVICE, [(f"{key}Ex", structs.COMMAND)])
    for name in _CONDITIONS.split():
        yield Row(f"Condition{name}", UNIT, [("Conditions", condition_kind(f"Condition{name}"))])
        yield Row(f"Assert{name}", UNIT, [("Asserts", condition_kind(f"Assert{name}"))])
    for key in ("StandardOutput", "StandardError"):
        yield Row(key, SERVICE, _output_choices(key))
    for key, kind in _EXTENDED.items():
        yield Row(key, SERVICE, [(key, kinds.BOOL), (f"{key}Ex", kind)])
    yield from (Row(key, SERVICE, choices) for key, choices in _ODD.items())


def _output_choices(key: str) -> Sequence[tuple[str, PropertyKind]]:
    modes = {"append": "ToAppend", "truncate": "ToTruncate", "file": ""}
    files = [(f"{key}File{end}", kinds.file_kind(mode)) for mode, end in modes.items()]
    return [*files, (key, _OUTPUTS)]


TABLE = {row.key: row for row in _rows()}
"""Every row by its key."""


RLIMITS = frozenset(f"Limit{name}" for name in _RLIMIT_KINDS)
"""Keys that are two properties on D-Bus: the hard limit LimitX and the soft limit LimitXSoft."""
