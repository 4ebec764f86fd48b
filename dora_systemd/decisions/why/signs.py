"""Recognizes failures of nodes by their last lines, and suggests a remedy."""

import re
import shlex
from collections.abc import Iterable, Sequence

_MORE = "see dora-systemd-security(7)"
_SIGNS: Sequence[tuple[tuple[str, ...], str]] = (
    (
        ("No module named 'dora'",),
        "its Python has no dora-rs: pip install dora-rs there, or give its environment with --venv",
    ),
    (
        ("/.cache/uv`",),
        "uv cannot write its cache: --property CacheDirectory=NAME --env UV_CACHE_DIR="
        f"/var/cache/NAME gives it one, {_MORE}",
    ),
    (
        ("Read-only file system", "EROFS"),
        "files are read-only in the sandbox: --writable PATH allows one (of a release none: "
        "--property StateDirectory=NAME gives the nodes $STATE_DIRECTORY, which stays), "
        f"{_MORE}",
    ),
    (
        (
            "No such file or directory: '/dev/",
            "No such file or directory: /dev/",
            "can't open camera by index",
        ),
        f"devices are hidden in the sandbox: --device PATH allows one, {_MORE}",
    ),
    (
        ("No such file or directory: '/tmp/", "No such file or directory: '/var/tmp/"),
        f"/tmp is private in the sandbox: --writable /tmp shares the one of the machine, {_MORE}",
    ),
    (
        ("can't open file '/",),
        "its file is not where it was: if somebody has replaced or removed its directory since the "
        "start, only a restart of the dataflow finds the new one",
    ),
    (
        ("Operation not permitted", "Address family not supported", "EPERM"),
        f"the sandbox may have refused that; try --sandbox none, {_MORE}",
    ),
)
"""Parts of lines of the C library, Python and Rust, the clearest signs first."""


_FULL = re.compile(
    r"(?:No space left on device|Disk quota exceeded|ENOSPC|EDQUOT)"
    r"(?:[^\n'\"]{0,40}['\"](?P<path>/[^\n'\"]{1,200})['\"])?"
)
"""What fails with it often says nothing of the path; Python puts it behind."""


def known_remedy(lines: Iterable[str], node: str = "the node") -> str:
    """The remedy for a node with these last lines, or "" if they do not tell."""
    text = "\n".join(lines)
    if full := _FULL.search(text):
        return _space(full["path"], node)
    return next((help_ for signs, help_ in _SIGNS if any(one in text for one in signs)), "")


def _space(path: str | None, node: str) -> str:
    """The remedy for a full file system. path: of a file that could not be written."""
    if path is None:
        return f"a file system that {node} writes to is full: df shows which one"
    return f"the file system of this file is full: df {shlex.quote(path)}"
