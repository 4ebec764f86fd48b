"""The table of unit properties: every one that `--property` can set, with its name on D-Bus.

Names, types and sections are those of org.freedesktop.systemd1(5), systemd.unit(5),
systemd.service(5), systemd.exec(5), systemd.kill(5) and systemd.resource-control(5).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from dora_systemd.decisions.properties import kinds, lists, numbers, structs
from dora_systemd.decisions.properties.kinds import PropertyKind, choice_kind, number_kind
from dora_systemd.decisions.properties.lists import condition_kind

UNIT = "Unit"
SERVICE = "Service"


@dataclass(frozen=True)
class Row:
    """One key of a unit file: its section, and the D-Bus names and kinds of its values.

    The first kind that accepts a text determines the property.
    """

    key: str
    section: str
    choices: Sequence[tuple[str, PropertyKind]]


def _names(text: str) -> list[str]:
    return text.split()


_BOOLS = _names("""
    CPUAccounting MemoryAccounting IOAccounting TasksAccounting IPAccounting
    NoNewPrivileges PrivateDevices PrivateNetwork PrivateMounts PrivateIPC
    ProtectKernelTunables ProtectKernelModules ProtectKernelLogs ProtectClock ProtectHostname
    MemoryDenyWriteExecute RestrictRealtime RestrictSUIDSGID LockPersonality DynamicUser RemoveIPC
    MountAPIVFS CPUSchedulingResetOnFork IgnoreSIGPIPE SyslogLevelPrefix SendSIGHUP SendSIGKILL
    TTYReset TTYVHangup TTYVTDisallocate RootDirectoryStartOnly RemainAfterExit
    RootEphemeral MemoryKSM SetLoginEnvironment CoredumpReceive MemoryZSwapWriteback BindLogSockets
""")
_UNIT_BOOLS = _names("""
    StopWhenUnneeded RefuseManualStart RefuseManualStop AllowIsolate IgnoreOnIsolate
    DefaultDependencies SurviveFinalKillSignal
""")
_TEXTS = _names("""
    User Group PAMName Slice TTYPath RootDirectory RootImage RootVerity SyslogIdentifier
    SELinuxContext Personality NetworkNamespacePath IPCNamespacePath LogNamespace UtmpIdentifier
    RootImagePolicy MountImagePolicy ExtensionImagePolicy
""")
_UNIT_TEXTS = _names("Description SourcePath RebootArgument JobTimeoutRebootArgument")
_WORDS = _names("""
    ReadWritePaths ReadOnlyPaths InaccessiblePaths ExecPaths NoExecPaths
    ExtensionDirectories ConfigurationDirectory StateDirectory CacheDirectory LogsDirectory
    SupplementaryGroups SystemCallArchitectures PassEnvironment UnsetEnvironment DisableControllers
    IPIngressFilterPath IPEgressFilterPath ImportCredential
""")
_UNIT_WORDS = _names("""
    Requires Requisite Wants BindsTo PartOf Upholds Conflicts Before After OnSuccess OnFailure
    PropagatesReloadTo ReloadPropagatedFrom PropagatesStopTo StopPropagatedFrom JoinsNamespaceOf
    RequiresMountsFor WantsMountsFor Documentation
""")
_DURATIONS = _names("""
    RestartSec RestartMaxDelaySec TimeoutStartSec TimeoutStopSec TimeoutAbortSec RuntimeMaxSec
    RuntimeRandomizedExtraSec WatchdogSec LogRateLimitIntervalSec CPUQuotaPeriodSec
    MemoryPressureThresholdSec ManagedOOMMemoryPressureDurationSec
""")
_UNIT_DURATIONS = _names("JobRunningTimeoutSec StartLimitIntervalSec")
_MEMORY_LIMITS = _names("""
    MemoryMin MemoryLow MemoryHigh MemoryMax MemorySwapMax MemoryZSwapMax
    DefaultMemoryMin DefaultMemoryLow
""")
_SIZES = _names("""
    StartupMemoryLow StartupMemoryHigh StartupMemoryMax StartupMemorySwapMax StartupMemoryZSwapMax
    DefaultStartupMemoryLow
""")
_SIZE_RLIMITS = _names("FSIZE DATA STACK CORE RSS AS MEMLOCK MSGQUEUE")
_COUNT_RLIMITS = _names("NOFILE NPROC LOCKS SIGPENDING NICE RTPRIO")
_COMMANDS = _names("""
    ExecCondition ExecStartPre ExecStart ExecStartPost ExecReload ExecStop ExecStopPost
""")
_CONDITIONS = _names("""
    Architecture Firmware Virtualization Host KernelCommandLine KernelVersion Credential
    Environment Security Capability ACPower NeedsUpdate FirstBoot PathExists PathExistsGlob
    PathIsDirectory PathIsSymbolicLink PathIsMountPoint PathIsReadWrite PathIsEncrypted
    DirectoryNotEmpty FileNotEmpty FileIsExecutable User Group ControlGroupController Memory CPUs
    CPUFeature OSRelease MemoryPressure CPUPressure IOPressure
""")
_ACTIONS = choice_kind(
    *("none", "reboot", "reboot-force", "reboot-immediate", "poweroff", "poweroff-force"),
    *("poweroff-immediate", "exit", "exit-force", "soft-reboot", "soft-reboot-force"),
    *("kexec", "kexec-force", "halt", "halt-force", "halt-immediate"),
)
_FAILURE_MODES = choice_kind("terminate", "abort", "kill")
_MANAGED_OOM = choice_kind("auto", "kill")
_JOB_MODES = choice_kind("fail", "replace", "replace-irreversibly", "isolate", "flush")
_RLIMIT_KINDS = {
    **dict.fromkeys(_SIZE_RLIMITS, kinds.SIZE_LIMIT),
    **dict.fromkeys(_COUNT_RLIMITS, kinds.COUNT_LIMIT),
    "CPU": kinds.SECONDS,
    "RTTIME": kinds.MICROSECONDS,
}
_OUTPUTS = choice_kind(
    *("inherit", "null", "tty", "journal", "kmsg", "journal+console", "kmsg+console", "socket")
)
_EXIT_STATUS = number_kind("i", 0, 255)
_NUMBER = number_kind("u", 0, 2**32 - 1)

_KINDS: dict[str, PropertyKind] = {
    "CPUWeight": kinds.CPU_WEIGHT,
    "StartupCPUWeight": kinds.CPU_WEIGHT,
    "IOWeight": kinds.WEIGHT,
    "StartupIOWeight": kinds.WEIGHT,
    "AllowedCPUs": structs.CPUS,
    "StartupAllowedCPUs": structs.CPUS,
    "AllowedMemoryNodes": structs.CPUS,
    "StartupAllowedMemoryNodes": structs.CPUS,
    "NUMAMask": structs.CPUS,
    "NUMAPolicy": numbers.NUMA_POLICY,
    "DevicePolicy": choice_kind("auto", "closed", "strict"),
    "DeviceAllow": structs.DEVICES,
    "IODeviceWeight": structs.WEIGHTS,
    "IOReadBandwidthMax": structs.BANDWIDTHS,
    "IOWriteBandwidthMax": structs.BANDWIDTHS,
    "IOReadIOPSMax": structs.BANDWIDTHS,
    "IOWriteIOPSMax": structs.BANDWIDTHS,
    "IPAddressAllow": structs.ADDRESSES,
    "IPAddressDeny": structs.ADDRESSES,
    "BPFProgram": structs.PROGRAMS,
    "RestrictNetworkInterfaces": lists.FILTER,
    "ManagedOOMSwap": _MANAGED_OOM,
    "ManagedOOMMemoryPressure": _MANAGED_OOM,
    "ManagedOOMMemoryPressureLimit": kinds.SHARE,
    "ManagedOOMPreference": choice_kind("none", "avoid", "omit"),
    "MemoryPressureWatch": choice_kind("no", "yes", "auto", "skip"),
    "ExecSearchPath": lists.SEARCH_PATH,
    "Environment": lists.ENVIRONMENT,
    # Set by dora-systemd itself; in the table because they need a text in unit files.
    "Type": kinds.TEXT,
    "NotifyAccess": kinds.TEXT,
    "KillMode": kinds.TEXT,
    "Delegate": kinds.BOOL,
    "DelegateSubgroup": kinds.TEXT,
    "RuntimeDirectory": lists.WORDS,
    "RuntimeDirectoryMode": kinds.MODE,
    "WorkingDirectory": kinds.TEXT,
    "ProtectSystem": choice_kind("no", "yes", "full", "strict"),
    "ProtectHome": choice_kind("no", "yes", "read-only", "tmpfs"),
    "ProtectProc": choice_kind("default", "noaccess", "invisible", "ptraceable"),
    "ProcSubset": choice_kind("all", "pid"),
    "PrivatePIDs": choice_kind("no", "yes"),
    "KeyringMode": choice_kind("inherit", "private", "shared"),
    "UtmpMode": choice_kind("init", "login", "user"),
    "RestrictNamespaces": numbers.NAMESPACES,
    "RestrictAddressFamilies": lists.FILTER,
    "RestrictFileSystems": lists.FILTER,
    "SystemCallFilter": lists.FILTER,
    "SystemCallLog": lists.FILTER,
    "SystemCallErrorNumber": numbers.ERROR_NUMBER,
    "CapabilityBoundingSet": numbers.CAPABILITIES,
    "AmbientCapabilities": numbers.CAPABILITIES,
    "SecureBits": numbers.SECURE_BITS,
    "AppArmorProfile": lists.PROFILE,
    "SmackProcessLabel": lists.PROFILE,
    "BindPaths": structs.BINDS,
    "BindReadOnlyPaths": structs.BINDS,
    "TemporaryFileSystem": structs.MOUNTS,
    "MountFlags": numbers.MOUNT_FLAGS,
    "LoadCredential": structs.CREDENTIALS,
    "LoadCredentialEncrypted": structs.CREDENTIALS,
    "Nice": number_kind("i", -20, 19),
    "OOMScoreAdjust": number_kind("i", -1000, 1000),
    "CPUSchedulingPolicy": numbers.CPU_POLICY,
    "CPUSchedulingPriority": number_kind("i", 0, 99),
    "IOSchedulingClass": numbers.IO_CLASS,
    "IOSchedulingPriority": number_kind("i", 0, 7),
    "TimerSlackNSec": kinds.NANOSECONDS,
    "UMask": kinds.MODE,
    "StateDirectoryMode": kinds.MODE,
    "CacheDirectoryMode": kinds.MODE,
    "LogsDirectoryMode": kinds.MODE,
    "ConfigurationDirectoryMode": kinds.MODE,
    "SyslogLevel": numbers.LOG_LEVEL,
    "LogLevelMax": numbers.LOG_LEVEL,
    "SyslogFacility": numbers.FACILITY,
    "LogRateLimitBurst": _NUMBER,
    "LogExtraFields": lists.FIELDS,
    "LogFilterPatterns": lists.PATTERNS,
    "FinalKillSignal": numbers.SIGNAL,
    "WatchdogSignal": numbers.SIGNAL,
    "Restart": choice_kind(
        *("no", "on-success", "on-failure", "on-abnormal", "on-watchdog", "on-abort", "always")
    ),
    "RestartMode": choice_kind("normal", "direct", "debug"),
    "RestartSteps": _NUMBER,
    "ExitType": choice_kind("main", "cgroup"),
    "OOMPolicy": choice_kind("continue", "stop", "kill"),
    "TimeoutStartFailureMode": _FAILURE_MODES,
    "TimeoutStopFailureMode": _FAILURE_MODES,
    "SuccessExitStatus": numbers.STATUSES,
    "RestartPreventExitStatus": numbers.STATUSES,
    "RestartForceExitStatus": numbers.STATUSES,
    "FileDescriptorStoreMax": _NUMBER,
    "FileDescriptorStorePreserve": choice_kind("no", "yes", "restart"),
}
_UNIT_KINDS: dict[str, PropertyKind] = {
    "StartLimitBurst": _NUMBER,
    "StartLimitAction": _ACTIONS,
    "FailureAction": _ACTIONS,
    "SuccessAction": _ACTIONS,
    "JobTimeoutAction": _ACTIONS,
    "FailureActionExitStatus": _EXIT_STATUS,
    "SuccessActionExitStatus": _EXIT_STATUS,
    "OnFailureJobMode": _JOB_MODES,
    "OnSuccessJobMode": _JOB_MODES,
    "CollectMode": choice_kind("inactive", "inactive-or-failed"),
}


_PLAIN: Sequence[tuple[str, PropertyKind, Sequence[str]]] = (
    (SERVICE, kinds.BOOL, _BOOLS),
    (UNIT, kinds.BOOL, _UNIT_BOOLS),
    (SERVICE, kinds.TEXT, _TEXTS),
    (UNIT, kinds.TEXT, _UNIT_TEXTS),
    (SERVICE, lists.WORDS, _WORDS),
    (UNIT, lists.WORDS, _UNIT_WORDS),
    (SERVICE, kinds.SIZE_LIMIT, _SIZES),
    *((SERVICE, kind, (key,)) for key, kind in _KINDS.items()),
    *((UNIT, kind, (key,)) for key, kind in _UNIT_KINDS.items()),
)
"""Keys with the same name on D-Bus, by section and kind."""

_ODD: dict[str, Sequence[tuple[str, PropertyKind]]] = {
    "TasksMax": [("TasksMaxScale", kinds.SHARE), ("TasksMax", kinds.COUNT_LIMIT)],
    "CPUQuota": [("CPUQuotaPerSecUSec", kinds.CPU_QUOTA)],
    "EnvironmentFile": [("EnvironmentFiles", structs.ENVIRONMENT_FILES)],
    "IODeviceLatencyTargetSec": [("IODeviceLatencyTargetUSec", structs.LATENCIES)],
    "CPUAffinity": [
        ("CPUAffinityFromNUMA", kinds.named_kind("b", {"numa": True})),
        ("CPUAffinity", structs.CPUS),
    ],
    # Booleans at first; for later values there is a second property on D-Bus.
    "PrivateTmp": [("PrivateTmp", kinds.BOOL), ("PrivateTmpEx", choice_kind("disconnected"))],
    "PrivateUsers": [
        ("PrivateUsers", kinds.BOOL),
        ("PrivateUsersEx", choice_kind("self", "identity", "full")),
    ],
    "ProtectControlGroups": [
        ("ProtectControlGroups", kinds.BOOL),
        ("ProtectControlGroupsEx", choice_kind("private", "strict")),
    ],
}


def _rows() -> Iterator[Row]:
    for section, kind, keys in _PLAIN:
        yield from (Row(key, section, [(key, kind)]) for key in keys)
    for section, keys in ((SERVICE, _DURATIONS), (UNIT, _UNIT_DURATIONS)):
        for key in keys:
            yield Row(key, section, [(key.removesuffix("Sec") + "USec", kinds.DURATION)])
    for key in _MEMORY_LIMITS:
        yield Row(key, SERVICE, [(f"{key}Scale", kinds.SHARE), (key, kinds.SIZE_LIMIT)])
    for name, kind in _RLIMIT_KINDS.items():
        for key in (f"Limit{name}", f"Limit{name}Soft"):
            yield Row(key, SERVICE, [(key, kind)])
    for key in _COMMANDS:
        yield Row(key, SERVICE, [(f"{key}Ex", structs.COMMAND)])
    for name in _CONDITIONS:
        yield Row(f"Condition{name}", UNIT, [("Conditions", condition_kind(f"Condition{name}"))])
        yield Row(f"Assert{name}", UNIT, [("Asserts", condition_kind(f"Assert{name}"))])
    for key in ("StandardOutput", "StandardError"):
        yield Row(key, SERVICE, _output_choices(key))
    yield from (Row(key, SERVICE, choices) for key, choices in _ODD.items())


def _output_choices(key: str) -> Sequence[tuple[str, PropertyKind]]:
    return [
        (f"{key}FileToAppend", kinds.prefixed_path_kind("append:")),
        (f"{key}FileToTruncate", kinds.prefixed_path_kind("truncate:")),
        (f"{key}File", kinds.prefixed_path_kind("file:")),
        (key, _OUTPUTS),
    ]


TABLE = {row.key: row for row in _rows()}
"""Every row by its key."""

RLIMITS = frozenset(f"Limit{name}" for name in _RLIMIT_KINDS)
"""Keys that are two properties: the hard limit LimitX and the soft limit LimitXSoft."""
