"""The setting `machines`: other machines that run nodes of the dataflow.

Imports only what every start has; dora_systemd.decisions.machines reads what is in an entry.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from dora_systemd.decisions.cell.machines import parse_machine
from dora_systemd.decisions.settings.kinds import Base, Kind, Setting, texts_of
from dora_systemd.errors import usage_error
from dora_systemd.values import quoted, scalar_text

HOST = "host"
"""The key of an entry that a flag gives."""


class Declared(NamedTuple):
    """A machine as it is written."""

    values: Mapping[str, Any]  # by key
    bases: tuple[Base, ...]  # of each source; None is a flag


Machines = Mapping[str, Declared]
"""Declared machines by name."""


def _parse(value: Any, base: Base) -> Machines:
    entries = value.items() if isinstance(value, Mapping) else map(_split, texts_of(value))
    return {
        parse_machine(scalar_text(name)): Declared(dict(given or {}), (base,))
        for name, given in entries
    }


def _split(text: str) -> tuple[str, Mapping[str, str]]:
    name, equals, host = text.partition("=")
    if not equals or not host:
        hint = "write NAME=[user@]HOST, such as gpu=alice@gpu-box"
        raise usage_error(f"cannot use {quoted(text)} as a machine", hint)
    return name, {HOST: host}


def _merge(lower: Machines, higher: Machines) -> Machines:
    """Join machines; those with the same name are joined key by key."""
    joined = {name: _joined(lower[name], higher[name]) for name in lower.keys() & higher.keys()}
    return {**lower, **higher, **joined}


def _joined(lower: Declared, higher: Declared) -> Declared:
    return Declared({**lower.values, **higher.values}, lower.bases + higher.bases)


_MACHINES = Kind[Machines](
    dict[str, dict[str, Any] | None] | list[str],
    "a mapping, NAME: {host: HOST}",
    _parse,
    lambda machines: [f"{name}={one.values.get(HOST, name)}" for name, one in machines.items()],
    is_repeatable=True,
    merge=_merge,
    metavar="NAME=HOST",
)
MACHINES = Setting[Machines](
    "machines",
    _MACHINES,
    {},
    "Another machine, for the nodes with this name in deploy.machine; HOST is for ssh(1).",
    flags=("--machine",),
    root_only=True,
)
MACHINE_SETTINGS: tuple[Setting[Any], ...] = (MACHINES,)
