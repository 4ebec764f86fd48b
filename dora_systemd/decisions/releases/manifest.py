"""release.json: describes a release and its files, for `releases` and for a rollback. Pure.

Also makes the id of a release, which names.py reads, and decides which files of a project a release
can have: the owner of the project names its files and links, so each is checked before root creates
it.
"""

import json
import posixpath
import re
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.values import SECOND, format_rounded_size, shown

MOST_FILES = 100_000
MOST_BYTES = 4 * 1024**3
"""Maximum number of files and bytes of a release."""
_SEEN = re.compile(r"(?:[0-9]{1,20} ){4}[0-9]{1,20}", re.ASCII)
_SETTLED_NS = 60 * 10**9
_MOST_PATH = 1024
_MOST_TARGET = 1024

FILE, LINK, DIRECTORY = "file", "link", "directory"


@dataclass(frozen=True)
class Found:
    """A file of a project before it is copied."""

    path: str  # relative to the project
    kind: str  # FILE, LINK, DIRECTORY, or a word for what no release has
    size: int = 0
    is_executable: bool = False
    target: str = ""  # of a link
    signature: str = ""  # changes with the content, see signature() in trust/courier.py
    # CLOCK_REALTIME of the last change of anything, a new hard link as well
    changed_ns: int = field(default=0, compare=False)

    @property
    def seen(self) -> str:
        """What is recorded of a file, to know later that it has not changed."""
        return f"{self.signature} {self.changed_ns}"


@dataclass(frozen=True)
class Stored:
    """A file of a release."""

    size: int = 0
    is_executable: bool = False
    digest: str = ""  # SHA-256 of its content
    target: str = ""  # only of a link
    # the build has made it; the project has no such file
    is_built: bool = field(default=False, compare=False)
    # Found.seen of the project's file with this content; "" if its content may change without it
    seen: str = field(default="", compare=False)


def check_found(one: Found) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for what a release cannot have."""
    reason, hint = "", "remove it, or name it in .gitignore"
    if not is_plain_path(one.path):
        reason, hint = "its name is not printable text", "rename it"
    elif one.kind == LINK:
        reason = _trouble_of_link(one.path, one.target)
        hint = "link to a file of the project, or copy what it leads to"
        if one.target.startswith("/"):
            hint = "link to a file of the project by a relative path, or copy what it leads to"
    elif one.kind != FILE:
        reason = f"it is a {one.kind}"
    if reason:
        raise refusal(one.path, reason, hint)


def check_amount(found: Iterable[Found]) -> int:
    """The bytes of all files. Raises DoraSystemdError (BAD_INPUT) if they are too many."""
    files = [one for one in found if one.kind == FILE]
    total = sum(one.size for one in files)
    if total > MOST_BYTES:
        largest = max(files, key=lambda one: one.size)
        amounts = f"{format_rounded_size(total)}, {format_rounded_size(largest.size)} of it here"
        most = format_rounded_size(MOST_BYTES)
        hint = f"a release has at most {most}: keep data elsewhere, or name it in .gitignore"
        raise refusal(largest.path, f"the project has {amounts}", hint)
    return total


def too_many(path: str) -> DoraSystemdError:
    """The error for a project with more than MOST_FILES files."""
    reason = f"the project has more than {MOST_FILES} files"
    return refusal(path or ".", reason, "name directories of data in .gitignore")


def settled(one: Found, at_ns: int) -> str:
    """Return Found.seen of a file that is read after `at_ns`, if each later change changes that.

    "" for a young one. Two changes can have the same time, and a program that has the file in its
    memory changes it for half a minute without another time, see vm.dirty_expire_centisecs. Only
    the time of the last change counts, which no program can set. at_ns: CLOCK_REALTIME.
    """
    if not _SEEN.fullmatch(one.seen):
        return ""
    return one.seen if at_ns - one.changed_ns > _SETTLED_NS else ""


def is_plain_path(path: str) -> bool:
    """Whether it is a relative path, of printable text, that stays below where it begins."""
    parts = path.split("/")
    is_short = len(path.encode("utf-8", "surrogatepass")) <= _MOST_PATH
    return path.isprintable() and is_short and not {"", ".", ".."} & {*parts}


def touched(old: Mapping[str, Stored], new: Mapping[str, Stored]) -> dict[str, list[str]]:
    """The paths that are added, changed and removed, sorted."""
    return {
        "added": sorted(new.keys() - old.keys()),
        "changed": sorted(one for one in new.keys() & old.keys() if new[one] != old[one]),
        "removed": sorted(old.keys() - new.keys()),
    }


def of_project(files: Mapping[str, Stored]) -> dict[str, Stored]:
    """The files of a release that its project had, and no build has made."""
    return {path: one for path, one in files.items() if not one.is_built}


def refusal(path: str, reason: str, hint: str) -> DoraSystemdError:
    """The error for a file of a project that is not copied."""
    return bad_input(f"cannot copy {shown(path)}: {reason}", hint)


def _trouble_of_link(path: str, target: str) -> str:
    """Return why a link could lead out of the project, or "".

    ".." behind a name is refused as well: the name may be a link itself, and then it is unknown
    where ".." leads.
    """
    if not target.isprintable() or not target or len(target) > _MOST_TARGET:
        return "its target is not printable text"
    parts = [part for part in target.split("/") if part not in ("", ".")]
    ups = next((place for place, part in enumerate(parts) if part != ".."), len(parts))
    depth = len([part for part in posixpath.dirname(path).split("/") if part])
    if target.startswith("/"):
        return f"it links to {shown(target)}, an absolute path, which is outside of every release"
    if ups > depth:
        return f"it links to {shown(target)}, which is not in the project"
    return f"it links to {shown(target)}, with .. behind a name" if ".." in parts[ups:] else ""


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
        raise bad_input(message, "remove that release, or deploy again") from error


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


_REVISION = r"[0-9a-f]{4,64}\+?"
_MOMENT = "%Y%m%dT%H%M%S"
_MOMENT_LENGTH = 15


def is_revision(text: str) -> bool:
    """Whether it is a revision of git in hexadecimal digits, "+" behind it for changed files."""
    return re.fullmatch(_REVISION, text) is not None


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
