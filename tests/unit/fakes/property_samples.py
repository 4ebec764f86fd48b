"""One assignment for every key that `--property` takes: what real systems may be given."""

from dora_systemd.decisions.properties import kinds, lists, numbers, structs
from dora_systemd.decisions.properties.assignments import parse_property
from dora_systemd.decisions.properties.kinds import PropertyKind
from dora_systemd.decisions.properties.table import TABLE
from dora_systemd.errors import DoraSystemdError

_BY_KIND: list[tuple[PropertyKind, str]] = [
    (kinds.BOOL, "yes"),
    (kinds.SIZE_LIMIT, "512M"),
    (kinds.COUNT_LIMIT, "40"),
    (kinds.SHARE, "33.33%"),
    (kinds.DURATION, "1min 30s"),
    (kinds.SECONDS, "1min"),
    (kinds.MICROSECONDS, "100ms"),
    (kinds.NANOSECONDS, "50us"),
    (kinds.CPU_QUOTA, "150%"),
    (kinds.WEIGHT, "200"),
    (kinds.CPU_WEIGHT, "idle"),
    (kinds.MODE, "0750"),
    (numbers.SIGNAL, "RTMIN+3"),
    (numbers.STATUSES, "75 SIGKILL FAILURE"),
    (numbers.CAPABILITIES, "CAP_SYS_NICE CAP_KILL"),
    (numbers.NAMESPACES, "~user net"),
    (numbers.SECURE_BITS, "noroot noroot-locked"),
    (numbers.LOG_LEVEL, "warning"),
    (numbers.FACILITY, "local3"),
    (numbers.CPU_POLICY, "batch"),
    (numbers.IO_CLASS, "best-effort"),
    (numbers.NUMA_POLICY, "interleave"),
    (numbers.MOUNT_FLAGS, "slave"),
    (numbers.ERROR_NUMBER, "EPERM"),
    (lists.FIELDS, "SITE=north hall 100%"),
    (lists.PATTERNS, "~debug: .*"),
    (structs.COMMAND, "-/bin/true 'a b' $HOME 100% \\x41"),
    (structs.ENVIRONMENT_FILES, "-/etc/default/robot"),
    (structs.DEVICES, "/dev/null rw"),
    (structs.MOUNTS, "/var/x:ro,size=1M /mnt"),
    (structs.BINDS, "-/srv/a:/mnt/a:norbind /srv"),
    (structs.BANDWIDTHS, "/dev/null 5M"),
    (structs.WEIGHTS, "/dev/null 200"),
    (structs.LATENCIES, "/dev/null 25ms"),
    (structs.ADDRESSES, "localhost 10.1.2.0/24 fe80::1"),
    (structs.CPUS, "0"),
    (structs.CREDENTIALS, "token:/etc/token"),
]
_BY_KEY = {
    # The last of the actions would halt the machine that these samples are tried on.
    **dict.fromkeys(("StartLimitAction", "FailureAction", "SuccessAction"), "none"),
    "JobTimeoutAction": "none",
    "ExecSearchPath": "/srv/x:/srv/100%",
    "Description": '100% of $it, "quoted"',
    "SourcePath": "/etc/robot.yml",
    "RebootArgument": "now",
    "JobTimeoutRebootArgument": "now",
    "User": "root",
    "Group": "root",
    "PAMName": "login",
    "Slice": "robots.slice",
    "TTYPath": "/dev/tty7",
    "RootDirectory": "/",
    "RootImage": "/srv/x.raw",
    "RootVerity": "/srv/x.verity",
    "SyslogIdentifier": "robot-1",
    "SELinuxContext": "system_u:system_r:init_t:s0",
    "Personality": "x86-64",
    "NetworkNamespacePath": "/run/netns/x",
    "IPCNamespacePath": "/run/ipcns/x",
    "LogNamespace": "robots",
    "UtmpIdentifier": "ab",
    "SupplementaryGroups": "root tty",
    "SystemCallArchitectures": "native",
    "PassEnvironment": "LANG TZ",
    "UnsetEnvironment": "LANG TZ=x",
    "Environment": 'A=1 \'B=a b 100% $x\' "C=\\"\\\\"',
    "DisableControllers": "cpu io",
    "ImportCredential": "robot.*",
    "ConfigurationDirectory": "robot",
    "StateDirectory": "robot/a robot/b",
    "CacheDirectory": "robot",
    "LogsDirectory": "robot",
    "IPIngressFilterPath": "/sys/fs/bpf/x",
    "IPEgressFilterPath": "/sys/fs/bpf/x",
    "BPFProgram": "egress:/sys/fs/bpf/x",
    "RequiresMountsFor": "/srv",
    "WantsMountsFor": "/srv",
    "Documentation": "man:dora(1) https://example.org/100%25",
    "RestrictNetworkInterfaces": "~eth0 eth1",
    "RestrictAddressFamilies": "AF_UNIX AF_INET",
    "RestrictFileSystems": "ext4 tmpfs",
    "SystemCallFilter": "~@mount @swap",
    "SystemCallLog": "@mount",
    "AppArmorProfile": "-robot",
    "SmackProcessLabel": "robot",
    "PrivateUsers": "self",
    "CPUSchedulingPriority": "0",
    "OOMScoreAdjust": "500",
    "Nice": "-5",
    "IOSchedulingPriority": "7",
    "ManagedOOMMemoryPressureDurationSec": "30s",
    "RuntimeRandomizedExtraSec": "5s",
    "CPUQuotaPeriodSec": "10ms",
}
_CONDITIONS = {
    **{"Architecture": "x86-64", "Firmware": "uefi", "Virtualization": "|!vm", "Host": "!robot"},
    **{"KernelVersion": ">=6.1", "Memory": ">=1G", "CPUs": "!>=4096", "ACPower": "true"},
    **{"NeedsUpdate": "!/etc", "FirstBoot": "no", "Capability": "CAP_KILL", "Security": "selinux"},
    **{"MemoryPressure": "!1%", "CPUPressure": "!1%", "IOPressure": "!1%", "CPUFeature": "sse4_2"},
    **{"ControlGroupController": "memory", "User": "root", "Group": "root", "Environment": "A=1"},
    **{"KernelCommandLine": "quiet", "Credential": "x", "OSRelease": "ID=debian"},
}


def settable_keys() -> list[str]:
    """Every key of the table that is not refused."""
    keys = []
    for key in TABLE:
        try:
            parse_property(f"{key}=")
        except DoraSystemdError as error:
            if error.hint == "leave it out":
                continue
        keys.append(key)
    return keys


def sample(key: str) -> str:
    """An assignment of `key` that systemd accepts."""
    return f"{key}={_sample_value(key)}"


def _sample_value(key: str) -> str:
    if key.startswith(("Condition", "Assert")):
        name = key.removeprefix("Condition").removeprefix("Assert")
        return _CONDITIONS.get(name, "|!/run/nothing 100%")
    kind = TABLE[key].choices[0][1]
    by_kind = [value for known, value in _BY_KIND if known is kind]
    choices = kind.expected.removeprefix("one of ").split(", ")
    is_choice = kind.expected.startswith("one of ")
    return _BY_KEY.get(key) or [*by_kind, *_other_values(key), *choices[-1:] * is_choice][0]


def _other_values(key: str) -> list[str]:
    if key in ("StandardOutput", "StandardError"):
        return ["append:/run/robot.log"]
    kind = TABLE[key].choices[0][1]
    if kind.expected.startswith("a whole number"):
        return ["5"]
    if key.endswith("ImagePolicy"):
        return ["root=verity"]
    is_unit = TABLE[key].section == "Unit"
    words = "a.service b-1.target" if is_unit else '/srv/x "/srv/a b"'
    return [words] if kind is lists.WORDS else []
