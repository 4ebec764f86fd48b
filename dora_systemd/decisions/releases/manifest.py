"""release.json: describes a release and its files, for `releases` and for a rollback. Pure.

Also makes the id of a release, which names.py reads.
"""

import json
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from dora_systemd.decisions.releases.entries import Stored
from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import SECOND, shown

SCHEMA = 1


@dataclass(frozen=True)
class Manifest:
    """A release."""

    id: str
    name: str
    uuid: str
    dataflow: str  # the path of its file in the tree
    source: str  # the project that it was copied from
    user: str  # User= of its nodes, "" in user scope
    revision: str
    created_us: int  # CLOCK_REALTIME µs
    versions: Mapping[str, str] = field(default_factory=dict)  # by name of the program
    files: Mapping[str, Stored] = field(default_factory=dict)
    # options of its deploy by name of the setting, as of given_texts()
    given: Mapping[str, str | list[str]] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes of all files, also of those that other releases share."""
        return sum(one.size for one in self.files.values())


def format_manifest(one: Manifest) -> str:
    """The text of release.json; only ASCII, whatever the names of files are."""
    value = {**vars(one), "schema": SCHEMA}
    value["files"] = {path: format_stored(stored) for path, stored in sorted(one.files.items())}
    return json.dumps(value, indent=1) + "\n"


def parse_manifest(text: str, path: str) -> Manifest:
    """The manifest in the file `path`. Raises DoraSystemdError (BAD_INPUT)."""
    try:
        value = json.loads(text)
        if value.pop("schema") != SCHEMA:
            raise ValueError("schema")
        files = {one: parse_stored(stored) for one, stored in value.pop("files").items()}
        versions = {str(name): str(one) for name, one in value.pop("versions", {}).items()}
        given = {str(name): _texts(one) for name, one in value.pop("given", {}).items()}
        created_us = _number(value.pop("created_us"))
        texts = {key: _text(one) for key, one in value.items()}
        return Manifest(**texts, created_us=created_us, versions=versions, files=files, given=given)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        message = f"cannot use {shown(path)}: it does not describe a release"
        hint = "remove that release, or deploy again"
        raise DoraSystemdError(message, hint, ExitCode.BAD_INPUT) from error


def format_stored(one: Stored) -> dict[str, Any]:
    """A file for release.json."""
    more = {**({"built": True} if one.is_built else {}), **({"seen": one.seen} if one.seen else {})}
    if one.target:
        return {"link": one.target, **more}
    return {"size": one.size, "executable": one.is_executable, "sha256": one.digest, **more}


def parse_stored(value: Mapping[str, Any]) -> Stored:
    """A file of release.json. Raises ValueError, TypeError, KeyError."""
    is_built = bool(value.get("built", False))
    if "link" in value:
        return Stored(target=str(value["link"]), is_built=is_built)
    size = _number(value["size"])
    is_executable, digest = bool(value["executable"]), str(value["sha256"])
    seen = str(value.get("seen", ""))
    return Stored(size, is_executable, digest, is_built=is_built, seen=seen)


def _number(value: object) -> int:
    if type(value) is not int:
        raise TypeError(value)
    return value


def _texts(value: object) -> str | list[str]:
    return [_text(one) for one in value] if isinstance(value, list) else _text(value)


def _text(value: object) -> str:
    if type(value) is not str:
        raise TypeError(value)
    return value


_REVISION = re.compile(r"[0-9a-f]{4,64}\+?")
_MOMENT = "%Y%m%dT%H%M%S"
_MOMENT_LENGTH = 15


def is_revision(text: str) -> bool:
    """Whether it is a revision of git in hexadecimal digits, "+" behind it for changed files."""
    return _REVISION.fullmatch(text) is not None


def new_id(at_us: int, revision: str, known: frozenset[str]) -> str:
    """The id of a release of that time, that sorts behind all of `known`.

    at_us: CLOCK_REALTIME µs. revision: of git, or "".
    """
    newest = max(known, default="")
    now = _id(at_us // SECOND, revision)
    # The clock may have been ahead, or be behind, as without a battery.
    return now if now > newest else _id(_second_of(newest) + 1, revision)


def _id(second: int, revision: str) -> str:
    moment = time.strftime(_MOMENT, time.gmtime(second))
    return f"{moment}-{revision}" if revision else moment


def _second_of(release_id: str) -> int:
    moment = datetime.strptime(release_id[:_MOMENT_LENGTH], _MOMENT)
    return int(moment.replace(tzinfo=UTC).timestamp())
