"""Property kinds whose values are lists of structures: files, mounts, devices, addresses, commands.

A PropertyKind of kinds.py has a D-Bus signature and two functions. `parse` turns the text of
`--property KEY=VALUE` into the value that StartTransientUnit takes, a tuple of tuples that matches
the signature; `format` turns that value into the texts of a unit file. Both must agree: `doractl
enable` writes files for what `doractl start` sends. The signatures are those of
org.freedesktop.systemd1(5), the texts those of systemd.exec(5), systemd.service(5) and
systemd.resource-control(5). CPUs are a bit mask and have their kind here too.

An empty text is an empty list, which resets the property, as an empty value does in a unit file.
A wrong order of a structure's members would not fail here: systemd would refuse it, or take one
member for another. Parsers raise ValueError or DoraSystemdError; assignments.py adds the key.
"""

import ipaddress
from collections.abc import Callable, Sequence

from dora_systemd.decisions.properties.kinds import PropertyKind, plain_text
from dora_systemd.decisions.properties.lists import lines
from dora_systemd.decisions.properties.syntax import escape_specifiers, quote_word, split_words
from dora_systemd.values import INFINITY, format_duration, parse_duration, parse_size

Pair = tuple[str, str]
Device = tuple[str, int]
"""Path of the device, and the amount."""
Address = tuple[int, bytes, int]
"""Address family, address in network byte order, and length of the prefix in bits."""
Bind = tuple[str, str, bool, int]
"""Source, target, whether a missing source is ignored, and flags of mount(2)."""
Command = tuple[str, tuple[str, ...], tuple[str, ...]]
"""Path, argv, and flags such as "no-env-expand", as ExecStartEx has them on D-Bus."""

MS_REC = 1 << 14
"""The flag of mount(2) that makes a bind mount recursive."""

_MAX_CPUS = 8192
_FAMILIES = {4: 2, 6: 10}
"""AF_INET and AF_INET6 of Linux, see address_families(7)."""

_DECIMAL_FACTORS = {"K": 1000, "M": 1000**2, "G": 1000**3, "T": 1000**4}
_COMMAND_FLAGS = {
    "-": "ignore-failure",
    ":": "no-env-expand",
    "+": "privileged",
    "!": "no-setuid",
}
"""Prefixes of a command line in systemd.service(5), and their names on D-Bus."""

_NETWORKS = {
    "any": ("0.0.0.0/0", "::/0"),
    "localhost": ("127.0.0.0/8", "::1/128"),
    "link-local": ("169.254.0.0/16", "fe80::/64"),
    "multicast": ("224.0.0.0/4", "ff00::/8"),
}


def format_command(command: Command) -> str:
    """The command line of `command` for a unit file, see systemd.service(5)."""
    path, argv, flags = command
    prefixes = "".join(char for char, name in _COMMAND_FLAGS.items() if name in flags)
    renamed = argv[:1] != (path,)  # "@": the second word is argv[0]
    words = [path, *argv] if renamed else argv
    return prefixes + "@" * renamed + " ".join(quote_word(word) for word in words)


def _parse_command(text: str) -> tuple[Command, ...]:
    rest = text.strip().lstrip("-:+!@")
    prefixes = text.strip()[: len(text.strip()) - len(rest)]
    words = split_words(rest)
    if not text.strip():
        return ()
    argv = words[1:] if "@" in prefixes else words
    if not argv or not words[0].startswith("/") or len(set(prefixes)) < len(prefixes):
        raise ValueError("not a command line")
    flags = tuple(name for char, name in _COMMAND_FLAGS.items() if char in prefixes)
    for word in words:
        if "\0" in word:
            raise ValueError("not a command line")
    return ((plain_text(words[0]), tuple(argv), flags),)


def _parse_environment_file(text: str) -> tuple[tuple[str, bool], ...]:
    path = plain_text(text)
    return ((path.removeprefix("-"), path.startswith("-")),) if path else ()


def _format_environment_files(value: Sequence[tuple[str, bool]]) -> Sequence[str]:
    return lines(["-" * is_optional + escape_specifiers(path) for path, is_optional in value])


def _parse_pair(text: str, separator: str) -> tuple[Pair, ...]:
    """Two words; the second one may be empty."""
    first, _, second = plain_text(text).partition(separator)
    return ((first, second.strip()),) if first else ()


def _format_pairs(value: Sequence[Pair], separator: str) -> Sequence[str]:
    return lines(
        [escape_specifiers(f"{one}{separator}{two}" if two else one) for one, two in value]
    )


def _parse_mounts(text: str) -> tuple[Pair, ...]:
    words = split_words(plain_text(text))
    pairs = [(plain_text(path), options) for path, _, options in (w.partition(":") for w in words)]
    if not all(path.startswith("/") for path, _ in pairs):
        raise ValueError("not a path")
    return tuple(pairs)


def _format_mounts(value: Sequence[Pair]) -> Sequence[str]:
    words = [f"{path}:{options}" if options else path for path, options in value]
    return [" ".join(quote_word(word) for word in words)]


def _parse_binds(text: str) -> tuple[Bind, ...]:
    return tuple(_parse_bind(word) for word in split_words(plain_text(text)))


def _parse_bind(word: str) -> Bind:
    source, *rest = plain_text(word).split(":")
    target, option = [*rest, "", ""][:2]
    path = source.removeprefix("-")
    if len(rest) > 2 or not path.startswith("/") or option not in ("", "rbind", "norbind"):
        raise ValueError("not a bind mount")
    return path, target or path, source != path, 0 if option == "norbind" else MS_REC


def _format_bind(bind: Bind) -> str:
    source, target, is_optional, flags = bind
    # Quote each path alone: systemd takes a ":" within quotes for a part of the path.
    paths = f"{quote_word('-' * is_optional + source)}:{quote_word(target)}"
    return paths + ("" if flags else ":norbind")


def _bandwidth(text: str) -> int:
    """Bytes or operations per second; K, M, G and T are powers of 1000 here, not of 1024."""
    factor = _DECIMAL_FACTORS.get(text[-1:], 1)
    amount = parse_size(text[:-1] if factor > 1 else text)
    return amount if amount == INFINITY else min(amount * factor, INFINITY)


def _weight(text: str) -> int:
    if not text.isascii() or not text.isdigit() or not 1 <= int(text[:9]) <= 10000:
        raise ValueError("not a weight")
    return int(text[:9])


def _format_amount(amount: int) -> str:
    return "infinity" if amount == INFINITY else str(amount)


def _parse_addresses(text: str) -> tuple[Address, ...]:
    networks = [net for word in text.split() for net in _NETWORKS.get(word, (word,))]
    return tuple(_address(ipaddress.ip_network(net, strict=False)) for net in networks)


def _address(network: ipaddress.IPv4Network | ipaddress.IPv6Network) -> Address:
    family = _FAMILIES[network.version]
    return family, network.network_address.packed, network.prefixlen


def _format_addresses(value: Sequence[Address]) -> Sequence[str]:
    return [" ".join(f"{ipaddress.ip_address(packed)}/{bits}" for _, packed, bits in value)]


def _parse_cpus(text: str) -> bytes:
    """A set such as "0-3,8" as a bit mask, lowest byte first."""
    mask = 0
    for word in text.replace(",", " ").split():
        first, dash, last = word.partition("-")
        if not all(one.isascii() and one.isdigit() for one in (first, last if dash else first)):
            raise ValueError("not a set")
        low, high = int(first[:9]), int((last if dash else first)[:9])
        if not low <= high < _MAX_CPUS:
            raise ValueError("not in range")
        mask |= (1 << (high + 1)) - (1 << low)
    return mask.to_bytes((mask.bit_length() + 7) // 8, "little")


def _format_cpus(value: bytes) -> Sequence[str]:
    mask = int.from_bytes(value, "little")
    return [" ".join(str(bit) for bit in range(mask.bit_length()) if mask >> bit & 1)]


def _device_kind(
    expected: str, parse: Callable[[str], int], format_: Callable[[int], str]
) -> PropertyKind:
    def parse_devices(text: str) -> tuple[Device, ...]:
        return tuple((path, parse(amount)) for path, amount in _parse_pair(text, " "))

    def format_devices(value: Sequence[Device]) -> Sequence[str]:
        return lines([f"{escape_specifiers(path)} {format_(amount)}" for path, amount in value])

    return PropertyKind("a(st)", expected, parse_devices, format_devices)


def _pair_kind(separator: str, expected: str) -> PropertyKind:
    return PropertyKind(
        "a(ss)",
        expected,
        lambda text: _parse_pair(text, separator),
        lambda value: _format_pairs(value, separator),
    )


COMMAND = PropertyKind(
    "a(sasas)",
    "a command line with an absolute path, such as /usr/bin/touch /run/x",
    _parse_command,
    lambda value: lines([format_command(command) for command in value]),
)
ENVIRONMENT_FILES = PropertyKind(
    "a(sb)",
    "a path, or - and one that may be absent",
    _parse_environment_file,
    _format_environment_files,
)
CREDENTIALS = PropertyKind(
    "a(ss)",
    "ID:PATH",
    # An ID without a path names a credential that the manager passes on, systemd.exec(5).
    lambda text: tuple((name, path or name) for name, path in _parse_pair(text, ":")),
    lambda value: _format_pairs(value, ":"),
)
DEVICES = _pair_kind(" ", "a device and what is allowed, such as /dev/video0 rw")
PROGRAMS = _pair_kind(":", "a type and a path, such as egress:/sys/fs/bpf/x")
MOUNTS = PropertyKind("a(ss)", "paths, each with :OPTIONS or not", _parse_mounts, _format_mounts)
BINDS = PropertyKind(
    "a(ssbt)",
    "SOURCE[:TARGET[:norbind]] with absolute paths",
    _parse_binds,
    lambda value: [" ".join(_format_bind(bind) for bind in value)],
)
BANDWIDTHS = _device_kind("a device and a rate, such as /dev/sda 5M", _bandwidth, _format_amount)
WEIGHTS = _device_kind("a device and a weight, such as /dev/sda 200", _weight, str)
LATENCIES = _device_kind(
    "a device and a time, such as /dev/sda 25ms", parse_duration, format_duration
)
ADDRESSES = PropertyKind(
    "a(iayu)",
    "networks such as 10.0.0.0/8, or any, localhost, link-local, multicast",
    _parse_addresses,
    _format_addresses,
)
CPUS = PropertyKind("ay", "a set of numbers such as 0-3,8", _parse_cpus, _format_cpus)
