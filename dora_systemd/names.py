"""Names of dataflows, their units, UUIDs, nodes and releases; no name can mean another unit.

For a name that is not known there is a hint with similar ones.
"""

import re
from collections.abc import Iterable
from pathlib import PurePath
from typing import Protocol

from dora_systemd.errors import DoraSystemdError, bad_input, usage_error
from dora_systemd.values import quoted

UNIT_PREFIX = "dora-"
UNIT_SUFFIX = ".service"
LINK_PREFIX = "doralink-"
"""Prefix of the units of links to other machines."""
NOTICE_PREFIX = "doranotice"
"""Prefix of the units that send the notice of a failure."""
SLICE = "dora.slice"
RESERVED_NAMES = frozenset({"gateway"})
"""dora-gateway.service is the gateway."""

MAX_NAME = 186
"""Maximum characters of a name: systemd makes a directory with the name of the unit, and 69 more
characters, for PrivateTmp=, and file names have at most 255."""

_LASTS = "".join(f"\\U{plane:04x}fffe\\U{plane:04x}ffff" for plane in range(17))
_UNREADABLE = f"[\\x00\\ud800-\\udfff\\ufdd0-\\ufdef{_LASTS}]"
"""NUL, surrogates, and what Unicode calls noncharacters."""
_NAME = rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME - 1}}}(?<!-)"
"""No "-" at its end: drop-ins of dora-x-.service are of all units dora-x-*, see systemd.unit(5)."""
MAX_NODE_ID = 200
"""Maximum characters: "node-ID" is a cgroup and "ID.out" a pipe, with names of at most 255 bytes.
"""

NODE_ID = r"(?!\.)[A-Za-z0-9_.-]+"
"""dora's own rule for node ids."""

_UNIT_SUFFIXES = (
    *(".service", ".socket", ".device", ".mount", ".automount", ".swap"),
    *(".target", ".path", ".timer", ".slice", ".scope"),
)
STORE = "dora-systemd/releases"
"""The directory of all releases, below that of states."""
TREE = "tree"
"""The directory of a project's files in a release."""
_RELEASE = r"[0-9]{8}T[0-9]{6}(?:-[0-9a-f]{4,64}\+?)?(?:\.[0-9]{1,4})?"
_RELEASE_PLACE = rf"/{STORE}/[^/]+/({_RELEASE})/{TREE}/"
_UUID = r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}"
_ZERO_UUID = "00000000-0000-0000-0000-000000000000"
_DESCRIPTION = rf"dora dataflow (\S+) \(({_UUID})\)(?:, release ({_RELEASE}))?"
MIN_PREFIX = 4
"""Minimum characters of the beginning of a UUID."""
_HINT = (
    f"a name is 1 to {MAX_NAME} letters, digits, '.', '_' or '-', begins with a letter or digit, "
    "and does not end with '-'"
)


class Named(Protocol):
    """A dataflow, from wherever it is known."""

    @property
    def name(self) -> str:
        """The name of the dataflow."""

    @property
    def uuid(self) -> str:
        """The UUID of the dataflow."""


def is_name(text: str) -> bool:
    """Whether it is a valid name for a dataflow."""
    try:
        return parse_name(text) == text
    except DoraSystemdError:
        return False


def parse_name(text: str) -> str:
    """Return a valid name unchanged. Raises DoraSystemdError (USAGE) for any other text."""
    hint = ""
    if not re.fullmatch(_NAME, text):
        hint = _HINT
    elif text.endswith(_UNIT_SUFFIXES):
        hint = "leave the unit suffix out: the unit is dora-NAME.service"
    elif text in RESERVED_NAMES:
        hint = f"dora-{text}.service is part of dora-systemd: choose another name"
    if hint:
        raise usage_error(f"cannot use {quoted(text)} as a name", hint)
    return text


PLAIN_STEM = "dataflow"


def settings_path(dataflow: str) -> str:
    """Return the path of the settings file next to a dataflow file; the file may not exist."""
    path = PurePath(dataflow)
    return str(path.with_name(f"{path.stem}.systemd.yml"))


def name_from_path(path: str) -> str:
    """The name from a dataflow file: its stem, with "-" for every character that is not valid.

    For a file called "dataflow", the name is that of its directory, if the path has one. Raises
    DoraSystemdError (USAGE) if nothing is left.
    """
    given = PurePath(path)
    plain = given.parent.name if given.stem == PLAIN_STEM and given.parent.name else given.stem
    stem = re.sub(r"[^A-Za-z0-9._-]+", "-", plain)
    name = re.sub(r"^[^A-Za-z0-9]+", "", stem)[:MAX_NAME].rstrip("-.")
    try:
        return parse_name(name)
    except DoraSystemdError as error:
        message = f"cannot make a name from {quoted(path)}"
        raise usage_error(message, "give one with --name") from error


def unit_name(name: str) -> str:
    """The systemd unit of the dataflow `name`, which must be valid."""
    return f"{UNIT_PREFIX}{name}{UNIT_SUFFIX}"


def notice_unit(name: str, suffix: str = UNIT_SUFFIX) -> str:
    """The unit that sends the notices of dataflow `name`; with ".path", the one that starts it."""
    return f"{NOTICE_PREFIX}@{name}{suffix}"


def notice_hold_unit(name: str) -> str:
    """The unit that keeps that of a failed dataflow loaded until notice_unit() has its setting."""
    return f"{NOTICE_PREFIX}-hold@{name}{UNIT_SUFFIX}"


def notice_command_unit(name: str) -> str:
    """The unit in which the command of a notice runs."""
    return f"{NOTICE_PREFIX}-{name}{UNIT_SUFFIX}"


def name_from_unit(unit: str) -> str | None:
    """The dataflow of `unit`, or None if it is not a unit of ours."""
    name = unit.removeprefix(UNIT_PREFIX).removesuffix(UNIT_SUFFIX)
    return name if unit == unit_name(name) and is_name(name) else None


def unit_description(name: str, uuid: str, release: str = "") -> str:
    """Description= of the unit, which systemd lists with the units: `list` needs no request."""
    return f"dora dataflow {name} ({uuid})" + (f", release {release}" if release else "")


def facts_from_description(unit: str, description: str) -> tuple[str, str] | None:
    """The UUID and the release, or "", in the Description= of a unit of ours; None if neither."""
    name = name_from_unit(unit)
    found = re.fullmatch(_DESCRIPTION, description)
    return (found[2], found[3] or "") if found and name and found[1] == name else None


def is_release_id(text: str) -> bool:
    """Whether it is the id of a release, such as 20261121T220012-9f3c1a2."""
    return re.fullmatch(_RELEASE, text) is not None


def release_of(path: str) -> str:
    """The release that a file is in, "" if it is in none.

    There is no registry: the unit names its dataflow file, and that path has the release in it.
    """
    found = re.search(_RELEASE_PLACE, path)
    return found[1] if found else ""


def is_node_id(text: str) -> bool:
    """Whether it is a valid node id for dora and for a cgroup."""
    return len(text) <= MAX_NODE_ID and re.fullmatch(NODE_ID, text) is not None


def is_uuid(text: str) -> bool:
    """Whether it is a UUID in lower case with dashes."""
    return re.fullmatch(_UUID, text) is not None


def parse_uuid(text: str) -> str:
    """The UUID in lower case with dashes. Raises DoraSystemdError (USAGE) for any other text."""
    if is_uuid(text.lower()):
        return text.lower()
    hint = "a UUID is 32 hexadecimal digits as 8-4-4-4-12"
    raise usage_error(f"cannot read {quoted(text)} as a UUID", hint)


def is_uuid_prefix(text: str, at_least: int = MIN_PREFIX) -> bool:
    """Whether `text` can be the beginning of a UUID: 4 to 36 hexadecimal digits and dashes.

    With fewer than 4 characters, a typing error could stop the wrong dataflow.
    """
    return len(text) >= at_least and is_uuid(text.lower() + _ZERO_UUID[len(text) :])


def check_known(problem: str, named: Iterable[str], nodes: Iterable[str]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for the first of `named` that is not in `nodes`.

    problem: the text before "the node", such as "cannot limit".
    """
    known = list(nodes)
    for node in named:
        if node not in known:
            hint = did_you_mean(node, known) or f"nodes: {', '.join(known)}"
            raise bad_input(f"{problem} the node {quoted(node)}: no such node", hint)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """A hint with up to three of the `known` words that are similar to `word`, or ""."""
    # Imported late: only needed after an error.
    import difflib

    by_lower = {one.lower().replace("-", "_"): one for one in known}
    wanted = word[:100].lower().replace("-", "_")
    if wanted in by_lower:
        return f"did you mean {by_lower[wanted]}?"
    near = [by_lower[one] for one in difflib.get_close_matches(wanted, by_lower, n=3)]
    return f"did you mean {' or '.join(near)}?" if near else ""


def is_readable(text: str) -> bool:
    """Whether systemd takes `text` from D-Bus and from a unit file, see utf8_is_valid() in systemd.

    Surrogates stand for bytes that are not UTF-8. D-Bus allows no NUL, and C would silently cut the
    string there.
    """
    return not re.search(_UNREADABLE, text)
