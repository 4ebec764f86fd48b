"""Names of dataflows, their units and UUIDs: nothing that gets past here is another unit."""

import re
from pathlib import PurePath

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import quoted

UNIT_PREFIX = "dora-"
UNIT_SUFFIX = ".service"
SLICE = "dora.slice"
RESERVED_NAMES = frozenset({"gateway"})
"""dora-gateway.service is our own front, see design."""

MAX_NAME = 200
"""Characters of a name: unit names end at 255 (systemd.unit(5)), and node names follow in paths."""

_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME - 1}}}")
MAX_NODE_ID = 200
"""Characters of an id: "node-ID" names a cgroup and "ID.out" a pipe, and names end at 255 bytes."""

NODE_ID = re.compile(r"(?!\.)[A-Za-z0-9_.-]+")
"""Dora's own rule for the id of a node."""

_UNIT_TYPES = (
    *("service", "socket", "device", "mount", "automount", "swap"),
    *("target", "path", "timer", "slice", "scope"),
)
_UNIT_SUFFIXES = tuple(f".{unit_type}" for unit_type in _UNIT_TYPES)
_UUID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
_UUID_DASHES = (8, 13, 18, 23)
_MIN_PREFIX = 4
_HINT = (
    f"a name is 1 to {MAX_NAME} letters, digits, '.', '_' or '-', and begins with a letter or digit"
)


def is_name(text: str) -> bool:
    """Whether a dataflow can be called so."""
    try:
        return parse_name(text) == text
    except DoraSystemdError:
        return False


def parse_name(text: str) -> str:
    """The name of a dataflow, unchanged; raises DoraSystemdError (USAGE) on any other text."""
    if not _NAME.fullmatch(text):
        raise DoraSystemdError(f"cannot use {quoted(text)} as a name", _HINT, ExitCode.USAGE)
    if text.endswith(_UNIT_SUFFIXES):
        hint = "leave the unit suffix out: the unit is dora-NAME.service"
        raise DoraSystemdError(f"cannot use {quoted(text)} as a name", hint, ExitCode.USAGE)
    if text in RESERVED_NAMES:
        hint = f"dora-{text}.service is part of dora-systemd: choose another name"
        raise DoraSystemdError(f"cannot use {quoted(text)} as a name", hint, ExitCode.USAGE)
    return text


PLAIN_STEM = "dataflow"


def settings_path(dataflow: str) -> str:
    """The settings file beside a dataflow file, which may be missing."""
    path = PurePath(dataflow)
    return str(path.with_name(f"{path.stem}.systemd.yml"))


def name_from_path(path: str) -> str:
    """The name that a dataflow file gives: its stem, every character a name lacks becoming "-".

    A file called "dataflow" says nothing: the directory of an absolute path names it then.
    Raises DoraSystemdError (USAGE) where nothing usable is left.
    """
    given = PurePath(path)
    plain = given.parent.name if given.stem == PLAIN_STEM and given.parent.name else given.stem
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", plain)
    name = re.sub(r"^[^A-Za-z0-9]+", "", stem)[:MAX_NAME].rstrip("-.")
    try:
        return parse_name(name)
    except DoraSystemdError as error:
        message = f"cannot make a name from {quoted(path)}"
        raise DoraSystemdError(message, "give one with --name", ExitCode.USAGE) from error


def unit_name(name: str) -> str:
    """The systemd unit of the dataflow `name`, which parse_name has accepted."""
    return f"{UNIT_PREFIX}{name}{UNIT_SUFFIX}"


def name_from_unit(unit: str) -> str | None:
    """The dataflow of `unit`, or None if that is no unit of ours."""
    if not (unit.startswith(UNIT_PREFIX) and unit.endswith(UNIT_SUFFIX)):
        return None
    try:
        return parse_name(unit.removeprefix(UNIT_PREFIX).removesuffix(UNIT_SUFFIX))
    except DoraSystemdError:
        return None


def is_node_id(text: str) -> bool:
    """Whether dora lets a node be called so, and a cgroup can."""
    return len(text) <= MAX_NODE_ID and NODE_ID.fullmatch(text) is not None


def is_uuid(text: str) -> bool:
    """Whether it is a UUID, in lower case and with dashes."""
    return _UUID.fullmatch(text) is not None


def parse_uuid(text: str) -> str:
    """The UUID in lower case with dashes; raises DoraSystemdError (USAGE) on any other text."""
    uuid = text.lower()
    if not _UUID.fullmatch(uuid):
        hint = "a UUID is 32 hexadecimal digits as 8-4-4-4-12"
        raise DoraSystemdError(f"cannot read {quoted(text)} as a UUID", hint, ExitCode.USAGE)
    return uuid


def is_uuid_prefix(text: str) -> bool:
    """Whether some UUID begins with `text`: 4 to 36 hexadecimal digits and dashes in their places.

    Fewer than 4 characters would let a slip of the finger stop somebody's robot.
    """
    if not _MIN_PREFIX <= len(text) <= 36:
        return False
    return all(
        char == "-" if place in _UUID_DASHES else char in "0123456789abcdef"
        for place, char in enumerate(text.lower())
    )
