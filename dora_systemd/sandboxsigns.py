"""What a node that dies says about the sandbox, and what helps."""

from collections.abc import Iterable, Sequence

_MORE = "see SANDBOX in dora-systemd(7)"
_SIGNS: Sequence[tuple[tuple[str, ...], str]] = (
    (
        ("Read-only file system", "EROFS"),
        f"the sandbox has files read-only: --writable PATH opens a place, {_MORE}",
    ),
    (
        ("No such file or directory: '/dev/", "No such file or directory: /dev/"),
        f"the sandbox hides devices: --device PATH opens one, {_MORE}",
    ),
    (
        ("No such file or directory: '/tmp/", "No such file or directory: '/var/tmp/"),
        f"the sandbox has a /tmp of its own: --writable /tmp shares that of the machine, {_MORE}",
    ),
    (
        ("Operation not permitted", "Address family not supported", "EPERM"),
        f"the sandbox may have refused that; --sandbox none tells, {_MORE}",
    ),
)
"""Parts of lines as the C library, Python and Rust write them, the plainest signs first."""


def sandbox_remedy(lines: Iterable[str]) -> str:
    """What helps a node whose last lines are these, or "" when they do not point at the sandbox."""
    text = "\n".join(lines)
    return next((help_ for signs, help_ in _SIGNS if any(one in text for one in signs)), "")
