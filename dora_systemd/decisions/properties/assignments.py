"""Parses and joins properties of one unit, from assignments as for `--property`."""

import re
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from dora_systemd.decisions.properties.kinds import Property
from dora_systemd.decisions.properties.table import (
    RLIMITS,
    TABLE,
    TABLE_VERSION,
    Row,
    bus_name,
    plain_kind,
)
from dora_systemd.errors import DoraSystemdError, usage_error
from dora_systemd.names import STORE, did_you_mean
from dora_systemd.values import quoted, shown

Properties = Mapping[str, Property]
"""Properties by slot: the key of the unit file, with "~" after it for a filter that excludes. A
later value of a slot replaces the earlier one or, for lists, is appended. Two slots can have the
same name on D-Bus: ConditionPathExists and ConditionHost are both Conditions."""

_WORD = "[a-z][a-z0-9-]*"
_DOUBLE_KEYS = {"TimeoutSec": ("TimeoutStartSec", "TimeoutStopSec")}

_SUPERVISED = "dora-systemd needs it to supervise the dataflow"
_REFUSED = {
    **dict.fromkeys(("Type", "NotifyAccess", "BusName", "PIDFile", "GuessMainPID"), _SUPERVISED),
    **dict.fromkeys(("ExecStart", "KillMode", "KillSignal", "RestartKillSignal"), _SUPERVISED),
    **dict.fromkeys(("Delegate", "DelegateControllers", "DelegateSubgroup"), _SUPERVISED),
    **dict.fromkeys(
        ("RuntimeDirectory", "RuntimeDirectoryMode", "RuntimeDirectoryPreserve"),
        "the state of the running dataflow is there",
    ),
    "WorkingDirectory": "--working-directory is that of the nodes",
    "StandardInput": "its end is the end of `doractl run`",
    "SetCredential": "everybody could read it in the unit, unlike LoadCredential=ID:PATH",
}
_DROP_IN = "write it into a drop-in instead: systemctl edit dora-NAME.service"
_UNSUPPORTED = (
    *("OpenFile", "NFTSet", "MountImages", "ExtensionImages", "RootImageOptions", "RootHash"),
    *("RootHashSignature", "SocketBindAllow", "SocketBindDeny", "SetCredentialEncrypted"),
    *("StandardInputText", "StandardInputData", "TTYRows", "TTYColumns", "CoredumpFilter"),
    *("NonBlocking", "TimeoutCleanSec", "ReloadSignal", "DebugInvocation", "JobTimeoutSec"),
)


class Newer(NamedTuple):
    """The version and keys of a systemd, to judge properties that the table does not contain."""

    version: int
    types: Mapping[str, str]  # signatures of a service's properties by name on D-Bus


NOTHING_NEWER = Newer(TABLE_VERSION, {})


def parse_property(assignment: str, newer: Newer = NOTHING_NEWER) -> dict[str, Property]:
    """The properties that KEY=VALUE sets, by slot: one, or two for a resource limit.

    Keys and values are those of systemd-run(1) --property, and what only `newer` knows. Raises
    DoraSystemdError (USAGE) for a key that services do not have or that dora-systemd sets itself,
    and for a bad value.
    """
    key, equals, text = assignment.partition("=")
    if not equals:
        raise _refusal(f"{quoted(assignment)}: it has no value", "write KEY=VALUE, such as Nice=5")
    properties: dict[str, Property] = {}
    for one in _DOUBLE_KEYS.get(key, (key,)):
        _check_key(one, newer)
        _check_directory(one, text)
        properties |= _parse_newer(one, text, newer) or parse_line(one, text)
    return properties


def unknown_keys(assignments: Iterable[str]) -> list[str]:
    """The keys of those that the table does not take: they are wrong, or for a newer systemd."""
    return [one.partition("=")[0] for one in assignments if not _is_known(one)]


def _is_known(assignment: str) -> bool:
    try:
        parse_property(assignment)
    except DoraSystemdError:
        return False
    return True


def _parse_newer(key: str, text: str, newer: Newer) -> dict[str, Property]:
    """A property that is not in the table, or one with a word that is not; {} for all others."""
    if key not in TABLE:
        signature = newer.types[bus_name(key)]
        kind = plain_kind(key, signature)
        if not kind:
            raise _refusal(f"{shown(key)} from here", _DROP_IN)
        try:
            return {key: Property(bus_name(key), signature, kind.parse(text))}
        except (ValueError, DoraSystemdError):
            raise _refusal(f"{key} to {quoted(text)}", f"write {kind.expected}") from None
    word = text.strip()
    if (
        newer.version > TABLE_VERSION
        and re.fullmatch(_WORD, word)
        and not _is_known(f"{key}={word}")
    ):
        for name, kind in TABLE[key].choices:
            if kind.is_choice:
                return {key: Property(name, "s", word)}
    return {}


def parse_line(key: str, text: str) -> dict[str, Property]:
    """The properties that the line KEY=TEXT of one of our own unit files sets, by slot.

    The text has no specifiers. Raises KeyError for a key that is not in the table, DoraSystemdError
    (USAGE) for a bad value.
    """
    if key not in RLIMITS:
        return _parse_one(key, text)
    soft, colon, hard = text.partition(":")
    limit = _parse_one(key, soft)[key]._replace(name=f"{key}Soft")
    return {limit.name: limit, **_parse_one(key, hard if colon else soft)}


def typed(**values: Any) -> dict[str, Property]:
    """Properties by key of the unit file, from values with their types on D-Bus."""
    rows = {key: TABLE[key].choices[-1] for key in values}
    return {key: Property(rows[key][0], rows[key][1].signature, values[key]) for key in values}


def with_assignments(
    properties: Properties, assignments: Iterable[str], newer: Newer = NOTHING_NEWER
) -> dict[str, Property]:
    """`properties`, then each KEY=VALUE. Raises DoraSystemdError as parse_property does."""
    result = dict(properties)
    for assignment in assignments:
        result = with_properties(result, parse_property(assignment, newer))
    return result


def with_properties(properties: Properties, changes: Properties) -> dict[str, Property]:
    """`properties`, then `changes`: scalars replace, lists are appended, empty lists reset."""
    result = dict(properties)
    for slot, new in changes.items():
        old = result.get(slot)
        result[slot] = _joined(old, new) if old and old.name == new.name else new
        if new.signature == "(bas)" and not new.value[1]:
            result.pop(f"{slot}~", None)
    return result


def format_property(slot: str, properties: Properties) -> list[str]:
    """The lines of a unit file for the property in `slot`.

    A soft resource limit is part of its hard one. A value that a unit file cannot express becomes a
    comment.
    """
    name, signature, value = properties[slot]
    key = slot.removesuffix("~")
    if key.endswith("Soft") and key.removesuffix("Soft") in RLIMITS:
        return []
    kind = dict(TABLE[key].choices)[name] if key in TABLE else plain_kind(key, signature)
    if not kind:
        return [f"# {name} is set by doractl"]
    text = kind.format(value)
    soft = properties.get(f"{key}Soft")
    if soft and soft.value != value:
        text = f"{kind.format(soft.value)}:{text}"
    return [f"{key}={line}" for line in text.split("\n")]


def _check_key(key: str, newer: Newer) -> None:
    if key in _REFUSED:
        raise _refusal(f"{shown(key)}: {_REFUSED[key]}", "leave it out")
    if key in _UNSUPPORTED:
        raise _refusal(f"{shown(key)} from here", _DROP_IN)
    if key not in TABLE and bus_name(key) not in newer.types:
        hint = did_you_mean(key, TABLE.keys() - _REFUSED.keys()) or "see systemd.directives(7)"
        raise _refusal(f"{shown(key)}: services have no such property", hint)


def _check_directory(key: str, text: str) -> None:
    """Refuse our own directory: systemd gives all that is in a StateDirectory= to User=."""
    ours = STORE.partition("/")[0]
    tops = {word.partition("/")[0] for word in text.replace(":", " ").split()}
    if key == "StateDirectory" and ours in tops:
        reason = "the releases of dataflows are there, and nodes must not change them"
        raise _refusal(f"{key} to {quoted(text)}: {reason}", "choose another name")


def _parse_one(key: str, text: str) -> dict[str, Property]:
    row = TABLE[key]
    reason: Exception | None = None
    for name, kind in row.choices:
        try:
            value = kind.parse(text)
        except (ValueError, DoraSystemdError) as error:
            reason = error
            continue
        slot = f"{key}~" if kind.signature == "(bas)" and not value[0] else key
        return {slot: Property(name, kind.signature, value)}
    raise _bad_value(row, text, reason)


def _bad_value(row: Row, text: str, reason: Exception | None) -> DoraSystemdError:
    hint = "write " + " or ".join(kind.expected for _, kind in row.choices)
    if row.key == "Environment":
        # The value may be a secret; the error names the variable.
        return _refusal(row.key, reason.hint if isinstance(reason, DoraSystemdError) else hint)
    return _refusal(f"{row.key} to {quoted(text)}", hint)


def _refusal(what: str, hint: str) -> DoraSystemdError:
    return usage_error(f"cannot set property {what}", hint)


def _joined(old: Property, new: Property) -> Property:
    if new.signature == "(bas)" and new.value[1]:
        return new._replace(value=(new.value[0], (*old.value[1], *new.value[1])))
    if new.signature == "(aiai)" and any(new.value):
        joined = tuple((*one, *two) for one, two in zip(old.value, new.value, strict=True))
        return new._replace(value=joined)
    if new.signature.startswith("a") and new.signature != "ay" and new.value:
        return new._replace(value=(*old.value, *new.value))
    return new
