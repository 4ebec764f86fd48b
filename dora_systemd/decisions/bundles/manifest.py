"""The manifest of a bundle, its last file: what the bundle is about, and the digest of each part.

A bundle without a manifest was cut. Whatever has another schema was written by another version.
"""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import chain, count
from typing import Any, NamedTuple

from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.values import as_list, as_mapping, format_moment, shown

KIND = "dora-systemd bundle"
SCHEMA = 1
RULES = "allowlist 1: no values of variables, no arguments, settings or credentials"
"""What may be in a bundle, in one line."""

README, WHY, MANIFEST, ERRORS = "README.txt", "why.json", "manifest.json", "errors.txt"
MOST_MANIFEST = 1 << 20
MOST_PARTS = 512
MOST_LETTERS = 90
"""Of a directory in the name of a part: the header of a tar file has no more room."""
_DIRECTORY = rf"(?!\.)[A-Za-z0-9_.-]{{1,{MOST_LETTERS}}}/"
_NAME = rf"({_DIRECTORY}){{0,2}}(?!\.)[A-Za-z0-9_.-]{{1,100}}"
_DIGEST = r"[0-9a-f]{64}"


class Part(NamedTuple):
    """A file in a bundle."""

    name: str
    size: int
    digest: str  # SHA-256, in hexadecimal


@dataclass(frozen=True)
class Manifest:
    """The content of manifest.json."""

    name: str  # of the dataflow
    uuid: str
    unit: str
    scope: str
    host: str
    at_us: int  # when it was written, CLOCK_REALTIME µs
    by: str  # who requested it, such as "root (doractl bundle)"
    event: str = ""  # what failed, a value of DORA_NOTICE_EVENT, or "" for a request
    node: str = ""  # that `why` names, or ""
    cause: str = ""  # see `cause` in dora-systemd-json(7)
    summary: str = ""  # what ended and how
    state: str = ""  # of the dataflow when the bundle was written, as in `list`
    versions: Mapping[str, str | None] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()  # what is not in the bundle, and why
    parts: tuple[Part, ...] = ()


def is_part_name(name: str) -> bool:
    """Whether it can be the name of a file in a bundle: no path that leads out of a directory."""
    return re.fullmatch(_NAME, name) is not None


def directory_names(texts: Iterable[str]) -> list[str]:
    """For each text another name that a part can have for its directory."""
    found: dict[str, None] = {}
    for text in texts:
        name = re.sub(r"[^A-Za-z0-9_.-]|^\.", "-", text)
        begin = name[: MOST_LETTERS - 6]
        names = chain([name] if 0 < len(name) <= MOST_LETTERS else [], _numbered(begin))
        found[next(one for one in names if one not in found)] = None
    return [*found]


def _numbered(begin: str) -> Iterable[str]:
    return (f"{begin}-{number}" for number in count(1))


def format_manifest(one: Manifest) -> str:
    """The text of manifest.json."""
    values = {
        "schema": SCHEMA,
        "kind": KIND,
        "name": one.name,
        "uuid": one.uuid,
        "unit": one.unit,
        "scope": one.scope,
        "host": one.host,
        "at": format_moment(one.at_us),
        "at_us": one.at_us,
        "by": one.by,
        "event": one.event,
        "node": one.node,
        "cause": one.cause,
        "summary": one.summary,
        "state": one.state,
        "versions": dict(one.versions),
        "rules": RULES,
        "left_out": list(one.left_out),
        "parts": [part._asdict() for part in one.parts],
    }
    return json.dumps(values, indent=2) + "\n"


def parse_manifest(data: bytes, source: str) -> Manifest:
    """Inverse of format_manifest(). source: the file of the bundle, for errors.

    Raises DoraSystemdError (BAD_INPUT) for what no doractl has written, or a newer one.
    """
    try:
        values = as_mapping(json.loads(data))
    except (ValueError, RecursionError) as error:
        raise no_bundle(source, "its manifest.json is not JSON") from error
    schema = values.get("schema")
    if values.get("kind") != KIND or type(schema) is not int:
        raise no_bundle(source, "its manifest.json is of something else")
    if schema > SCHEMA:
        message = f"cannot read {shown(source)}: a newer doractl has written it (schema {schema})"
        raise bad_input(message, "use that version of doractl")
    try:
        return _parsed(values)
    except (ValueError, TypeError, KeyError) as error:
        raise no_bundle(source, "its manifest.json has wrong values") from error


def no_bundle(source: str, reason: str) -> DoraSystemdError:
    """The error for a file that is no bundle."""
    message = f"cannot read {shown(source)} as a bundle: {reason}"
    return bad_input(message, "doractl bundle NAME writes one")


def _parsed(values: Mapping[str, Any]) -> Manifest:
    texts = ("name", "uuid", "unit", "scope", "host", "by", "event", "node", "cause", "summary")
    parts = as_list(values["parts"])
    left_out = as_list(values["left_out"])
    if len(parts) > MOST_PARTS or len(left_out) > MOST_PARTS:
        raise ValueError(parts)
    versions = as_mapping(values["versions"])
    return Manifest(
        **{key: _text(values[key]) for key in texts},
        state=_text(values.get("state", "")),  # earlier versions have none
        at_us=_number(values["at_us"]),
        versions={_text(key): None if one is None else _text(one) for key, one in versions.items()},
        left_out=tuple(map(_text, left_out)),
        parts=tuple(map(_part, parts)),
    )


def _part(value: Any) -> Part:
    known = as_mapping(value)
    name, digest = _text(known["name"]), _text(known["digest"])
    if not is_part_name(name) or not re.fullmatch(_DIGEST, digest):
        raise ValueError(name)
    return Part(name, _number(known["size"]), digest)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(value)
    return value


def _number(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(value)
    return value
