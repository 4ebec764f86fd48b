"""The files of a project, and which of them a release can have. Pure.

The owner of the project names its files and links, so each is checked before root creates it.
"""

import posixpath
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from dora_systemd.errors import DoraSystemdError, ExitCode
from dora_systemd.values import format_rounded_size, shown

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
    return DoraSystemdError(f"cannot copy {shown(path)}: {reason}", hint, ExitCode.BAD_INPUT)


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
