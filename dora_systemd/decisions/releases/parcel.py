"""What `deploy -H` sends: a line of JSON that lists the project, then the files that are missing.

The host answers the line with the numbers of the contents that it lacks, and gets these, one behind
the other. Pure.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dora_systemd.decisions.releases.manifest import (
    FILE,
    LINK,
    MOST_FILES,
    Found,
    Stored,
    check_amount,
    check_found,
    format_stored,
    is_plain_path,
    is_revision,
    parse_stored,
    too_many,
)
from dora_systemd.errors import DoraSystemdError, bad_input
from dora_systemd.names import parse_name
from dora_systemd.values import as_mapping

SCHEMA = 1
MOST_HEAD = 64 * 1024 * 1024
"""Maximum bytes of the first line: 100,000 files have about 20 MB."""
_DIGEST = "[0-9a-f]{64}"
_MOST_SOURCE = 4096


@dataclass(frozen=True)
class Parcel:
    """A project on its way to another host."""

    name: str
    source: str  # the project's directory on the sender, only shown
    dataflow: str  # the path of the dataflow file, relative to `source`
    directory: str | None  # the working directory, relative to `source`; None for the file's
    revision: str  # of git, or ""
    files: Mapping[str, Stored] = field(default_factory=dict)
    owner: str = ""  # the user who owns the files, "" if root or the sender does

    @property
    def contents(self) -> list[Stored]:
        """A file for each content, in the order of their numbers."""
        return list({one.digest: one for one in self.files.values() if not one.target}.values())


def format_parcel(one: Parcel) -> bytes:
    """The first line."""
    files = {path: format_stored(stored) for path, stored in one.files.items()}
    return json.dumps({"schema": SCHEMA, **vars(one), "files": files}).encode() + b"\n"


def parse_parcel(line: bytes) -> Parcel:
    """Parse the parcel of a first line. Raises DoraSystemdError (BAD_INPUT) for another line."""
    try:
        value = json.loads(line)
        if value.pop("schema") != SCHEMA:
            raise _refusal("it comes from another version of doractl", "install the same version")
        files = {path: parse_stored(stored) for path, stored in value.pop("files").items()}
        one = Parcel(**value, files=files)
        _check_types(one)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise _refusal("it does not describe a project", "use doractl deploy -H") from error
    parse_name(one.name)
    _check_files(one.files)
    return one


def _check_types(one: Parcel) -> None:
    """Raise ValueError or TypeError for what no project has."""
    texts = (one.name, one.source, one.revision, one.dataflow, one.directory or ".", one.owner)
    if not all(isinstance(text, str) and len(text) <= _MOST_SOURCE for text in texts):
        raise TypeError
    is_below = one.directory in (None, ".") or is_plain_path(one.directory or "")
    if one.dataflow not in one.files or not is_below:
        raise ValueError(one.dataflow)
    if one.revision and not is_revision(one.revision):
        raise ValueError(one.revision)
    if not (one.source.isprintable() and one.owner.isprintable()):
        raise ValueError(one.source)


def _check_files(files: Mapping[str, Stored]) -> None:
    """Raise DoraSystemdError (BAD_INPUT) for what a release cannot have."""
    if len(files) > MOST_FILES:
        raise too_many("")
    found = [_found(path, stored) for path, stored in files.items()]
    for one in found:
        check_found(one)
    check_amount(found)
    if not all(one.target or re.fullmatch(_DIGEST, one.digest) for one in files.values()):
        raise _refusal("a file has no digest", "use doractl deploy -H")
    sizes = {one.digest: one.size for one in files.values()}
    if any(one.size < 0 or one.size != sizes[one.digest] for one in files.values()):
        raise _refusal("a file has no size", "use doractl deploy -H")


def _found(path: str, one: Stored) -> Found:
    kind = LINK if one.target else FILE
    return Found(path, kind, one.size, one.is_executable, one.target)


def format_wants(numbers: Iterable[int]) -> str:
    """The answer to a first line, without the end of the line."""
    return json.dumps({"wants": list(numbers)})


def parse_wants(value: Any, parcel: Parcel) -> list[Stored] | None:
    """Parse an answer to the contents that the host requests; None for an invalid answer."""
    wants, contents = as_mapping(value).get("wants"), parcel.contents
    if not isinstance(wants, list) or len(wants) > len(contents):
        return None
    if not all(type(one) is int and 0 <= one < len(contents) for one in wants):
        return None
    if len({*wants}) != len(wants):
        return None
    return [contents[one] for one in wants]


def missing(parcel: Parcel, there: Mapping[str, Stored]) -> list[int]:
    """The numbers of the contents that no file in `there` has."""
    known = {one.digest for one in there.values()}
    return [number for number, one in enumerate(parcel.contents) if one.digest not in known]


def total(contents: Sequence[Stored]) -> int:
    """Return the bytes of all contents."""
    return sum(one.size for one in contents)


def _refusal(reason: str, hint: str) -> DoraSystemdError:
    return bad_input(f"cannot read a project from standard input: {reason}", hint)
