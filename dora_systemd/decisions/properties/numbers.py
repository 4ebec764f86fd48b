"""Property kinds whose words mean numbers: signals, exit statuses, capabilities, levels."""

import errno
import signal
from collections.abc import Mapping, Sequence

from dora_systemd.decisions.properties.kinds import PropertyKind, word_kind, word_of

_CAPABILITY_NAMES = (
    *("chown", "dac_override", "dac_read_search", "fowner", "fsetid", "kill", "setgid", "setuid"),
    *("setpcap", "linux_immutable", "net_bind_service", "net_broadcast", "net_admin", "net_raw"),
    *("ipc_lock", "ipc_owner", "sys_module", "sys_rawio", "sys_chroot", "sys_ptrace", "sys_pacct"),
    *("sys_admin", "sys_boot", "sys_nice", "sys_resource", "sys_time", "sys_tty_config", "mknod"),
    *("lease", "audit_write", "audit_control", "setfcap", "mac_override", "mac_admin", "syslog"),
    *("wake_alarm", "block_suspend", "audit_read", "perfmon", "bpf", "checkpoint_restore"),
)
"""The capabilities in the order of their numbers, see capabilities(7)."""

_CAPABILITIES = {f"CAP_{name.upper()}": 1 << bit for bit, name in enumerate(_CAPABILITY_NAMES)}

_NAMESPACES = {
    "cgroup": 0x02000000,
    "ipc": 0x08000000,
    "net": 0x40000000,
    "mnt": 0x00020000,
    "pid": 0x20000000,
    "user": 0x10000000,
    "uts": 0x04000000,
}
"""The CLONE_NEW* flags of clone(2)."""

_SECURE_BITS = {
    "keep-caps": 1 << 4,
    "keep-caps-locked": 1 << 5,
    "no-setuid-fixup": 1 << 2,
    "no-setuid-fixup-locked": 1 << 3,
    "noroot": 1 << 0,
    "noroot-locked": 1 << 1,
}
_EVERY_NAMESPACE = sum(_NAMESPACES.values())
_LEVELS = ("emerg", "alert", "crit", "err", "warning", "notice", "info", "debug")
_FACILITIES = (
    *("kern", "user", "mail", "daemon", "auth", "syslog", "lpr", "news", "uucp", "cron"),
    *("authpriv", "ftp"),
)
_SIGNALS = {
    **{f"SIGRTMIN+{number}": signal.SIGRTMIN + number for number in range(1, 31)},
    **signal.Signals.__members__,
}


def _parse_statuses(text: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Exit statuses and signals; a number is an exit status, as in systemd.service(5)."""
    statuses: list[int] = []
    signals: list[int] = []
    for word in text.split():
        try:
            statuses.append(_STATUS.parse(word))
        except ValueError:
            signals.append(SIGNAL.parse(word))
    return tuple(statuses), tuple(signals)


def _format_statuses(value: tuple[Sequence[int], Sequence[int]]) -> str:
    return " ".join([*map(str, value[0]), *map(SIGNAL.format, value[1])])


def _numbered(words: Sequence[str]) -> dict[str, int]:
    return {word: number for number, word in enumerate(words)}


def _mask_kind(
    signature: str,
    expected: str,
    bits: Mapping[str, int],
    everything: int = 0,
    words: Mapping[str, int] = {},
) -> PropertyKind:
    """The sum of named bits; "~" in front removes them from `everything`. words: whole masks."""
    known = {name.lower(): bit for name, bit in bits.items()}

    def parse(text: str) -> int:
        given = text.strip()
        names = set(given.removeprefix("~").lower().split())
        if given in words:
            return words[given]
        if not names <= known.keys():
            raise ValueError("unknown word")
        mask = sum(known[name] for name in names)
        return everything & ~mask if given.startswith("~") else mask

    def format_(mask: int) -> str:
        # Kernels may have more capabilities than this list, so format a nearly full mask inverted.
        is_inverted = mask > sum(bits.values())
        names = " ".join(name for name, bit in bits.items() if bool(mask & bit) != is_inverted)
        return word_of(mask, words, "~" * is_inverted + names)

    return PropertyKind(signature, expected, parse, format_)


_SIGNAL = word_kind(
    "i",
    _SIGNALS | {name.removeprefix("SIG"): number for name, number in _SIGNALS.items()},
    range(1, signal.SIGRTMAX + 1),
    "a signal such as SIGINT",
)
SIGNAL = _SIGNAL._replace(parse=lambda text: int(_SIGNAL.parse(text.upper())))
_STATUS = word_kind("i", {"SUCCESS": 0, "FAILURE": 1}, range(256))
STATUSES = PropertyKind(
    "(aiai)", "exit statuses and signals such as 75 SIGKILL", _parse_statuses, _format_statuses
)
CAPABILITIES = _mask_kind(
    "t",
    "capabilities such as CAP_NET_RAW CAP_SYS_NICE, or ~ and those to leave out",
    _CAPABILITIES,
    2**64 - 1,
)
NAMESPACES = _mask_kind(
    "t",
    "yes, no, or namespaces among " + ", ".join(_NAMESPACES),
    _NAMESPACES,
    _EVERY_NAMESPACE,
    # An empty value in a unit file resets it.
    dict.fromkeys(("no", "false", "off", "0", ""), _EVERY_NAMESPACE)
    | dict.fromkeys(("yes", "true", "on", "1"), 0),
)
SECURE_BITS = _mask_kind("i", "words among " + ", ".join(_SECURE_BITS), _SECURE_BITS)
LOG_LEVEL = word_kind("i", _numbered(_LEVELS), range(8))
FACILITY = word_kind(
    "i", _numbered(_FACILITIES) | {f"local{number}": 16 + number for number in range(8)}
)
CPU_POLICY = word_kind("i", {"other": 0, "fifo": 1, "rr": 2, "batch": 3, "idle": 5})
IO_CLASS = word_kind("i", _numbered(("none", "realtime", "best-effort", "idle")), range(4))
NUMA_POLICY = word_kind("i", _numbered(("default", "preferred", "bind", "interleave", "local")))
MOUNT_FLAGS = word_kind("t", {"": 0, "shared": 1 << 20, "slave": 1 << 19, "private": 1 << 18})
ERROR_NUMBER = word_kind(
    "i",
    {name: number for number, name in sorted(errno.errorcode.items())} | {"kill": 0x7FFFFFFE},
    errno.errorcode,
)
