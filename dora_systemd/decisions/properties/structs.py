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
import re
from collections.abc import Sequence

from dora_systemd.decisions.properties import kinds
from dora_systemd.decisions.properties.kinds import (
    PropertyKind,
    escape_specifiers,
    plain_text,
    quote_word,
    split_words,
)
from dora_systemd.decisions.properties.lists import items_kind, marked, words_kind
from dora_systemd.values import INFINITY, parse_size

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

_RANGE = "([0-9]{1,9})(?:-([0-9]{1,9}))?"
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


def _format_command(command: Command) -> str:
    """The command line of `command` for a unit file, see systemd.service(5)."""
    path, argv, flags = command
    prefixes = "".join(char for char, name in _COMMAND_FLAGS.items() if name in flags)
    renamed = argv[:1] != (path,)  # "@": the second word is argv[0]
    words = [path, *argv] if renamed else argv
    return prefixes + "@" * renamed + " ".join(quote_word(word) for word in words)


def _parse_command(text: str) -> tuple[Command, ...]:
    command = text.strip()
    rest = command.lstrip("-:+!@")
    prefixes, words = command.removesuffix(rest), split_words(rest)
    if not command:
        return ()
    argv = words[1:] if "@" in prefixes else words
    is_path = bool(argv) and words[0].startswith("/")
    if not is_path or len(set(prefixes)) < len(prefixes) or "\0" in command:
        raise ValueError("not a command line")
    flags = tuple(name for char, name in _COMMAND_FLAGS.items() if char in prefixes)
    return ((plain_text(words[0]), tuple(argv), flags),)


def _pair_of(text: str, separator: str) -> Pair:
    """Two words; the second one may be empty."""
    first, _, second = text.partition(separator)
    if not first:
        raise ValueError("the first word is missing")
    return first, second.strip()


def _joined(pair: Pair, separator: str) -> str:
    first, second = pair
    return f"{first}{separator}{second}" if second else first


def _parse_credential(text: str) -> Pair:
    name, path = _pair_of(text, ":")
    # An ID without a path names a credential that the manager passes on, systemd.exec(5).
    return name, path or name


def _parse_mount(word: str) -> Pair:
    path, _, options = word.partition(":")
    if not path.startswith("/"):
        raise ValueError("not a path")
    return path, options


def _parse_bind(word: str) -> Bind:
    source, *rest = word.split(":")
    target, option = [*rest, "", ""][:2]
    is_optional, path = marked("-", source)
    if len(rest) > 2 or not path.startswith("/") or option not in ("", "rbind", "norbind"):
        raise ValueError("not a bind mount")
    return path, target or path, is_optional, 0 if option == "norbind" else MS_REC


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


def _parse_addresses(text: str) -> tuple[Address, ...]:
    words = [network for word in text.split() for network in _NETWORKS.get(word, (word,))]
    networks = [ipaddress.ip_network(word, strict=False) for word in words]
    return tuple(
        (_FAMILIES[one.version], one.network_address.packed, one.prefixlen) for one in networks
    )


def _format_addresses(value: Sequence[Address]) -> str:
    return " ".join(f"{ipaddress.ip_address(packed)}/{bits}" for _, packed, bits in value)


def _parse_cpus(text: str) -> bytes:
    """A set such as "0-3,8" as a bit mask, lowest byte first."""
    mask = 0
    for word in text.replace(",", " ").split():
        found = re.fullmatch(_RANGE, word)
        low, high = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
        if not low <= high < _MAX_CPUS:
            raise ValueError("not a set of numbers")
        mask |= (1 << (high + 1)) - (1 << low)
    return mask.to_bytes((mask.bit_length() + 7) // 8, "little")


def _format_cpus(value: bytes) -> str:
    mask = int.from_bytes(value, "little")
    return " ".join(str(bit) for bit in range(mask.bit_length()) if mask >> bit & 1)


def _pair_kind(separator: str, expected: str) -> PropertyKind:
    return items_kind(
        "a(ss)",
        expected,
        lambda text: _pair_of(text, separator),
        lambda pair: escape_specifiers(_joined(pair, separator)),
    )


def _device_kind(amount: PropertyKind, expected: str) -> PropertyKind:
    def parse_device(text: str) -> Device:
        path, value = _pair_of(text, " ")
        return path, amount.parse(value)

    def format_device(device: Device) -> str:
        path, value = device
        return f"{escape_specifiers(path)} {amount.format(value)}"

    return items_kind("a(st)", expected, parse_device, format_device)


COMMAND = PropertyKind(
    "a(sasas)",
    "a command line with an absolute path, such as /usr/bin/touch /run/x",
    _parse_command,
    lambda value: "\n".join(map(_format_command, value)),
)
ENVIRONMENT_FILES = items_kind(
    "a(sb)",
    "a path, or - and one that may be absent",
    lambda text: marked("-", text)[::-1],
    lambda file: "-" * file[1] + escape_specifiers(file[0]),
)
CREDENTIALS = items_kind(
    "a(ss)", "ID:PATH", _parse_credential, lambda pair: escape_specifiers(":".join(pair))
)
DEVICES = _pair_kind(" ", "a device and what is allowed, such as /dev/video0 rw")
PROGRAMS = _pair_kind(":", "a type and a path, such as egress:/sys/fs/bpf/x")
MOUNTS = words_kind(
    "a(ss)",
    "paths, each with :OPTIONS or not",
    _parse_mount,
    lambda pair: quote_word(_joined(pair, ":")),
)
BINDS = words_kind(
    "a(ssbt)", "SOURCE[:TARGET[:norbind]] with absolute paths", _parse_bind, _format_bind
)
BANDWIDTHS = _device_kind(
    kinds.COUNT_LIMIT._replace(parse=_bandwidth), "a device and a rate, such as /dev/sda 5M"
)
WEIGHTS = _device_kind(kinds.WEIGHT, "a device and a weight, such as /dev/sda 200")
LATENCIES = _device_kind(kinds.DURATION, "a device and a time, such as /dev/sda 25ms")
ADDRESSES = PropertyKind(
    "a(iayu)",
    "networks such as 10.0.0.0/8, or any, localhost, link-local, multicast",
    _parse_addresses,
    _format_addresses,
)
CPUS = PropertyKind("ay", "a set of numbers such as 0-3,8", _parse_cpus, _format_cpus)
